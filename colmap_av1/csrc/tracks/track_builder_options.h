// Options of building tracks.
#pragma once

#include <cstdint>
#include <cstdlib>
#include <optional>
#include <vector>

namespace colmap_av1::tracks {

// A limit without a value is off. TrackOptions in the package's options/tracks.py documents
// meanings and units.
struct TrackBuilderOptions {
  int min_length = 4;
  std::optional<double> cosine;
  bool cosine_relative_to_dominant = true;
  double cosine_scale = 1;
  std::optional<int> max_interval;
  std::optional<int> max_block_area;
  std::optional<int> max_uncoded_block_area;
  std::optional<double> smoothness;
  std::optional<double> border;
  std::optional<double> interpolation;
  std::optional<double> bridge;
  int cells = 1;  // along either side of a unit
  // Number of cells along either side of a square in which a track starts; a divisor of 2 * cells.
  int seeding = 1;
  // Display indices of the frames whose observations are stored; without a value, all frames.
  std::optional<std::vector<std::int32_t>> stored_frames;
  // One in this many tracks, chosen by a hash, is sampled: it also stores its first and last
  // observation in any shown frame. 0: none.
  int tracks_per_sample = 0;

  bool is_within_reach(int interval) const {
    return !max_interval || std::abs(interval) <= *max_interval;
  }
};

}  // namespace colmap_av1::tracks
