// Points that lie on the same surface, and close to each other in a picture.
#pragma once

#include <cstdint>
#include <span>
#include <vector>

namespace colmap_av1::geometry {

struct SurfaceOptions {
  std::span<const std::int64_t> spacings;  // px; widths of cells, wide ones first
  double steps_per_octave = 0;             // of depth; what is a step apart is another surface
  std::int64_t most_steps = 0;             // from which on all is one surface
};

// Of points in a picture, the index of the first spacing at which each is the best one of its cell
// and surface; the number of spacings where it is at none. Pixels are [n][2] and lie within the
// picture, depths are finite and above 0; the best point is that of the least rank. Throws
// std::invalid_argument for what does not fit.
std::vector<std::int64_t> best_at_spacings(std::span<const double> xy,
                                           std::span<const double> depth,
                                           std::span<const std::int64_t> rank, std::int64_t width,
                                           std::int64_t height, const SurfaceOptions& options);

}  // namespace colmap_av1::geometry
