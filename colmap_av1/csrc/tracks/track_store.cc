#include "tracks/track_store.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <stdexcept>

namespace colmap_av1::tracks {

TrackStore::TrackStore(const TrackBuilderOptions& options)
    : min_length_(options.min_length),
      stored_frames_(options.stored_frames),
      tracks_per_sample_(options.tracks_per_sample) {
  if (stored_frames_) std::ranges::sort(*stored_frames_);
}

bool TrackStore::stores(const ChainedFrame& frame) const {
  return !stored_frames_ || std::ranges::binary_search(*stored_frames_, frame.motion.display_index);
}

void TrackStore::set_size(int width, int height) {
  width_ = width;
  height_ = height;
}

std::int32_t TrackStore::start(ChainedFrame& frame, std::size_t cell) {
  auto index = static_cast<std::int32_t>(tracks_.size());
  if (free_tracks_.empty()) {
    tracks_.emplace_back();
    last_seen_.emplace_back();
    serials_.emplace_back();
    if (tracks_per_sample_ > 0) ends_.emplace_back();
  } else {
    index = free_tracks_.back();
    free_tracks_.pop_back();
    tracks_[index] = Track{};
  }
  last_seen_[index] = -1;
  serials_[index] = frame.first_serial + static_cast<std::int64_t>(cell);
  Track& track = tracks_[index];
  track.frames = 1;
  frame.cells[cell].track = index;
  if (frame.is_shown()) count(index, frame, frame.cells[cell], stores(frame));
  return index;
}

void TrackStore::observe(const ChainedFrame& frame) {
  const bool is_stored = stores(frame);
  for (const Cell& cell : frame.cells) {
    if (cell.track >= 0) count(cell.track, frame, cell, is_stored);
  }
}

void TrackStore::count(std::int32_t index, const ChainedFrame& frame, const Cell& cell,
                       bool is_stored) {
  Track& track = tracks_[index];
  ++track.length;
  const bool is_sample = is_sampled(index);
  if (!is_stored && !is_sample) return;
  const Observation seen = observation(frame, cell);
  if (is_stored) store(track, seen);
  if (!is_sample) return;
  if (track.length == 1) ends_[index].first = seen;
  ends_[index].last = seen;
}

TrackStore::Observation TrackStore::observation(const ChainedFrame& frame, const Cell& cell) const {
  const float scale_x = static_cast<float>(width_) / frame.motion.width;
  const float scale_y = static_cast<float>(height_) / frame.motion.height;
  return {frame.motion.display_index,
          {cell.position.x * scale_x, cell.position.y * scale_y},
          std::sqrt(cell.variance) * scale_y};
}

void TrackStore::store(Track& track, const Observation& observation) {
  const int place = track.num_stored % kChunkSize;
  if (place == 0) start_chunk(track);
  chunks_[track.last_chunk].observations[place] = observation;
  ++track.num_stored;
}

void TrackStore::start_chunk(Track& track) {
  auto index = static_cast<std::int32_t>(previous_chunk_.size());
  if (!free_chunks_.empty()) {
    index = free_chunks_.back();
    free_chunks_.pop_back();
  } else if (chunks_.size() < std::numeric_limits<std::int32_t>::max()) {
    chunks_.emplace_back();
    previous_chunk_.push_back(-1);
  } else {
    throw std::length_error("too many observations at a time: cut the video");
  }
  previous_chunk_[index] = track.last_chunk;
  track.last_chunk = index;
}

void TrackStore::release(ChainedFrame& frame) {
  const int min_stored = stored_frames_ ? 2 : 1;
  for (std::size_t i = 0; i < frame.cells.size(); ++i) {
    const Cell& cell = frame.cells[i];
    if (cell.track == kSeed && length(frame, cell) >= min_length_) start(frame, i);
    if (cell.track < 0) continue;
    Track& track = tracks_[cell.track];
    if (--track.frames > 0) continue;
    free_tracks_.push_back(cell.track);
    if (track.length >= min_length_) {
      if (track.num_stored >= min_stored) keep(cell.track);
      if (is_sampled(cell.track)) {
        ends_[cell.track].serial = serials_[cell.track];
        kept_ends_.push_back(ends_[cell.track]);
      }
    }
    for (std::int32_t s = track.last_chunk; s >= 0; s = previous_chunk_[s]) {
      free_chunks_.push_back(s);
    }
  }
}

void TrackStore::keep(std::int32_t index) {
  const Track& track = tracks_[index];
  const auto first = static_cast<std::ptrdiff_t>(done_.frame.size());
  kept_.push_back({serials_[index], first, track.num_stored});
  const std::size_t size = done_.frame.size() + static_cast<std::size_t>(track.num_stored);
  done_.frame.resize(size);
  done_.xy.resize(2 * size);
  done_.sigma.resize(size);
  auto frame = done_.frame.end();
  auto xy = done_.xy.end();
  auto sigma = done_.sigma.end();
  std::int32_t chunk = track.last_chunk;
  for (int i = track.num_stored - 1; i >= 0; --i) {
    const Observation& observation = chunks_[chunk].observations[i % kChunkSize];
    *--frame = observation.frame;
    *--xy = observation.position.y;
    *--xy = observation.position.x;
    *--sigma = observation.sigma;
    if (i % kChunkSize == 0) chunk = previous_chunk_[chunk];
  }
}

TrackArrays TrackStore::finish() {
  std::sort(kept_.begin(), kept_.end(),
            [](const Kept& a, const Kept& b) { return a.serial < b.serial; });
  tracks_.clear();
  chunks_.clear();
  TrackArrays out;
  out.width = width_;
  out.height = height_;
  out.offsets.reserve(kept_.size() + 1);
  out.offsets.push_back(0);
  for (const Kept& kept : kept_) out.offsets.push_back(out.offsets.back() + kept.length);
  // Arrays are filled one at a time, the largest first, to need the least memory.
  const auto take_sorted = [this]<typename T>(std::deque<T>& values, std::ptrdiff_t width) {
    std::vector<T> sorted(values.size());
    auto end = sorted.begin();
    for (const Kept& kept : kept_) {
      const auto first = values.begin() + width * kept.first;
      end = std::copy(first, first + width * kept.length, end);
    }
    values = {};
    return sorted;
  };
  out.xy = take_sorted(done_.xy, 2);
  out.frame = take_sorted(done_.frame, 1);
  out.sigma = take_sorted(done_.sigma, 1);
  return out;
}

TrackArrays TrackStore::finish_ends() {
  std::ranges::sort(kept_ends_, {}, &Ends::serial);
  TrackArrays out;
  out.width = width_;
  out.height = height_;
  out.offsets.push_back(0);
  const auto add = [&out](const Observation& observation) {
    out.frame.push_back(observation.frame);
    out.xy.insert(out.xy.end(), {observation.position.x, observation.position.y});
    out.sigma.push_back(observation.sigma);
  };
  for (const Ends& ends : kept_ends_) {
    add(ends.first);
    if (ends.last.frame != ends.first.frame) add(ends.last);
    out.offsets.push_back(static_cast<std::int64_t>(out.frame.size()));
  }
  return out;
}

}  // namespace colmap_av1::tracks
