// Selects tracks that are spread over the pictures.
#pragma once

#include <cstdint>
#include <span>
#include <vector>

namespace colmap_av1::tracks {

struct SpreadOptions {
  double spacing = 0;            // width of the cells in px, at least 1; 0: no cells
  int max_tracks_per_image = 0;  // 0: no limit
  int min_length = 1;
};

// A view of tracks in the layout of TrackArrays.
struct TrackView {
  int num_frames = 0;
  std::span<const std::int64_t> offsets;
  std::span<const std::int32_t> frame;
  std::span<const float> xy;
};

// Returns one flag for each observation: 1 if it is kept. Tracks are selected in `order`, best
// first. A track is kept if at least half of its observations lie in pictures that are not full,
// and there in cells of width `spacing` without a better track. It loses its observations in full
// pictures, and is removed if fewer than `min_length` remain. Throws std::invalid_argument for
// inconsistent arrays.
std::vector<std::uint8_t> select_spread(const TrackView& tracks,
                                        std::span<const std::int64_t> order,
                                        const SpreadOptions& options);

}  // namespace colmap_av1::tracks
