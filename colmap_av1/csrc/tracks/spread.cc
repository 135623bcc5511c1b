#include "tracks/spread.h"

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <stdexcept>

namespace colmap_av1::tracks {
namespace {

constexpr double kMaxSide = 1 << 17;  // px; no picture is larger

void check(const TrackView& tracks, std::span<const std::int64_t> order) {
  const std::size_t total = tracks.frame.size();
  if (tracks.offsets.empty() || tracks.offsets.front() != 0 ||
      tracks.offsets.back() != static_cast<std::int64_t>(total) || tracks.xy.size() != 2 * total ||
      !std::is_sorted(tracks.offsets.begin(), tracks.offsets.end())) {
    throw std::invalid_argument("offsets, frame and xy do not fit each other");
  }
  const auto num_tracks = static_cast<std::int64_t>(tracks.offsets.size()) - 1;
  for (const std::int64_t track : order) {
    if (track < 0 || track >= num_tracks)
      throw std::invalid_argument("order holds an index of no track");
  }
  for (const std::int32_t frame : tracks.frame) {
    if (frame < 0 || frame >= tracks.num_frames) {
      throw std::invalid_argument("a frame is not one of the video's");
    }
  }
  for (const float value : tracks.xy) {
    if (!(value >= 0.F && value <= kMaxSide)) {
      throw std::invalid_argument("a position lies outside every picture");
    }
  }
}

}  // namespace

std::vector<std::uint8_t> select_spread(const TrackView& tracks,
                                        std::span<const std::int64_t> order,
                                        const SpreadOptions& options) {
  check(tracks, order);
  const std::size_t total = tracks.frame.size();
  // Narrower cells would select hardly more tracks, and need much memory.
  const double width = std::max(1.0, options.spacing);
  const auto cell_at = [width](float value) {
    return static_cast<std::int64_t>(static_cast<double>(value) / width);
  };
  // The grid of every picture extends to the outermost observation.
  std::int64_t cols = 1;
  std::int64_t rows = 1;
  std::vector<std::int64_t> cell;
  std::int64_t num_pictures = 0;  // with observations
  if (options.spacing > 0) {
    std::vector<std::int64_t> number(static_cast<std::size_t>(tracks.num_frames), -1);
    for (const std::int32_t frame : tracks.frame) {
      std::int64_t& own = number[static_cast<std::size_t>(frame)];
      if (own < 0) own = num_pictures++;
    }
    for (std::size_t i = 0; i < total; ++i) {
      cols = std::max(cols, cell_at(tracks.xy[2 * i]) + 1);
      rows = std::max(rows, cell_at(tracks.xy[2 * i + 1]) + 1);
    }
    cell.resize(total);
    for (std::size_t i = 0; i < total; ++i) {
      const std::int64_t picture = number[static_cast<std::size_t>(tracks.frame[i])];
      cell[i] = (picture * rows + cell_at(tracks.xy[2 * i + 1])) * cols + cell_at(tracks.xy[2 * i]);
    }
  }
  std::vector<std::uint8_t> taken(static_cast<std::size_t>(num_pictures * rows * cols));
  std::vector<std::int32_t> count(static_cast<std::size_t>(tracks.num_frames));
  std::vector<std::uint8_t> kept(total);
  const auto is_full = [&](std::int32_t frame) {
    return options.max_tracks_per_image > 0 &&
           count[static_cast<std::size_t>(frame)] >= options.max_tracks_per_image;
  };
  for (const std::int64_t track : order) {
    const auto first = static_cast<std::size_t>(tracks.offsets[static_cast<std::size_t>(track)]);
    const auto last = static_cast<std::size_t>(tracks.offsets[static_cast<std::size_t>(track) + 1]);
    std::int64_t usable = 0;
    std::int64_t useful = 0;
    for (std::size_t i = first; i < last; ++i) {
      if (is_full(tracks.frame[i])) continue;
      ++usable;
      if (cell.empty() || taken[static_cast<std::size_t>(cell[i])] == 0) ++useful;
    }
    if (usable < std::max(1, options.min_length) ||
        2 * useful < static_cast<std::int64_t>(last - first)) {
      continue;
    }
    for (std::size_t i = first; i < last; ++i) {
      if (is_full(tracks.frame[i])) continue;
      kept[i] = 1;
      ++count[static_cast<std::size_t>(tracks.frame[i])];
      if (!cell.empty()) taken[static_cast<std::size_t>(cell[i])] = 1;
    }
  }
  return kept;
}

}  // namespace colmap_av1::tracks
