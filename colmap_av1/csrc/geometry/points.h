// Errors, angles and occlusions of points that are observed in posed images.
#pragma once

#include <cstdint>
#include <span>
#include <vector>

namespace colmap_av1::geometry {

// A view of points and their observations in posed images, in compressed sparse row form.
struct ObservedPoints {
  std::span<const double> cam_from_world;     // [num_views][3][4]
  std::span<const double> focal;              // [num_views][2]; converts errors to pixels
  std::span<const std::int64_t> view;         // of each observation, with or without a point
  std::span<const double> rays;               // [num_observations][2], (x / z, y / z) in the camera
  std::span<const double> xyz;                // [num_points][3]
  std::span<const std::int64_t> offsets;      // [num_points + 1]
  std::span<const std::int64_t> observation;  // index of each point's observations
};

// Reprojection error in pixels of each observation of the points, in their order; infinite behind
// the camera. Like all functions here, throws std::invalid_argument for inconsistent arrays.
std::vector<double> reprojection_errors(const ObservedPoints& points);

// Largest triangulation angle in radians of points [n][3]. Only angles to the rays of a point's
// first and last observation are compared, so the result can be slightly too small. 0 without
// observations, and if positions are not finite. Observations are in compressed sparse row form,
// with the camera of each one in `view`.
std::vector<double> widest_angles(std::span<const double> centres, std::span<const double> xyz,
                                  std::span<const std::int64_t> offsets,
                                  std::span<const std::int64_t> view);

struct FloaterOptions {
  // Largest distance of a floater, as a share of the median in its square.
  double distance_share = 0;
  // Points support each other if the ratio of their distances is at most this.
  double near_ratio = 0;
  // A point that this many points support, itself included, is not a floater.
  std::int64_t support = 0;
  double square_width = 0;            // px
  std::int64_t fewest_in_square = 0;  // squares with fewer points are ignored
};

// For each point, the number of its observations as a floater: nearer than most points in the same
// square of the image, with hardly any other point at the same distance. Rays and points that are
// not finite are ignored. Also throws if squares have no width.
std::vector<std::int64_t> floater_observations(const ObservedPoints& points,
                                               const FloaterOptions& options);

}  // namespace colmap_av1::geometry
