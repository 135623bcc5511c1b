// Selection among points of the same surface that are close to each other in a picture.
#pragma once

#include <cstdint>
#include <span>
#include <vector>

namespace colmap_av1::geometry {

struct SurfaceOptions {
  std::span<const std::int64_t> spacings;  // px; widths of cells, descending
  double steps_per_octave = 0;             // of depth; points a step apart are on other surfaces
  std::int64_t most_steps = 0;             // number of steps; beyond the last is one surface
};

// For each point in a picture, the index of the first spacing at which it is the best point of its
// cell and surface; the number of spacings if there is none. Pixels are [n][2] and lie within the
// picture; depths are finite and above 0. The best point has the smallest rank. Throws
// std::invalid_argument for inconsistent arrays and invalid values.
std::vector<std::int64_t> best_at_spacings(std::span<const double> xy,
                                           std::span<const double> depth,
                                           std::span<const std::int64_t> rank, std::int64_t width,
                                           std::int64_t height, const SurfaceOptions& options);

}  // namespace colmap_av1::geometry
