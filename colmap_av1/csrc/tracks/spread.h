// Chooses tracks that are spread over the pictures.
#pragma once

#include <cstdint>
#include <span>
#include <vector>

namespace colmap_av1::tracks {

struct SpreadOptions {
  double spacing = 0;            // px between the tracks of a picture, on average; 0: any
  int max_tracks_per_image = 0;  // 0: any number
  int min_length = 1;
};

// Borrowed tracks in the layout of TrackArrays.
struct TrackView {
  int num_frames = 0;
  std::span<const std::int64_t> offsets;
  std::span<const std::int32_t> frame;
  std::span<const float> xy;
};

// One flag for each observation: 1 where it is kept. Tracks are taken in `order`, best first. One
// is kept where at least half of its observations lie in pictures that are not full, and there in
// cells, `spacing` wide, that no better track lies in. It loses the observations in full pictures,
// and is left out where fewer than `min_length` remain. Throws std::invalid_argument for arrays
// that do not fit each other.
std::vector<std::uint8_t> select_spread(const TrackView& tracks,
                                        std::span<const std::int64_t> order,
                                        const SpreadOptions& options);

}  // namespace colmap_av1::tracks
