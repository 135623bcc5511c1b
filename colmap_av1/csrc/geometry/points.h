// What posed images tell of points that they see.
#pragma once

#include <cstdint>
#include <span>
#include <vector>

namespace colmap_av1::geometry {

// Borrowed: points and where posed images see them, in compressed sparse row form.
struct SeenPoints {
  std::span<const double> cam_from_world;     // [num_views][3][4]
  std::span<const double> focal;              // [num_views][2]; turns errors into pixels
  std::span<const std::int64_t> view;         // of each observation, those of points and others
  std::span<const double> rays;               // [num_observations][2], (x / z, y / z) in the camera
  std::span<const double> xyz;                // [num_points][3]
  std::span<const std::int64_t> offsets;      // [num_points + 1]
  std::span<const std::int64_t> observation;  // index of each point's observations
};

// Reprojection error in pixels of each observation of the points, one after the other; infinite
// behind the camera. Throws std::invalid_argument for arrays that do not fit, as all functions
// here.
std::vector<double> reprojection_errors(const SeenPoints& points);

// Widest angle in radians at which the rays of points [n][3] from the centres of cameras meet:
// against those of a point's first and its last observation, so at most a little less. 0 without
// observations, and where places are not finite. Observations are in compressed sparse row form,
// the camera of each in `view`.
std::vector<double> widest_angles(std::span<const double> centres, std::span<const double> xyz,
                                  std::span<const std::int64_t> offsets,
                                  std::span<const std::int64_t> view);

struct HangingOptions {
  double before = 0;   // share of the surroundings' distance up to which a point is before them
  double as_near = 0;  // factor within which another point is as near
  std::int64_t support = 0;        // points as near, itself too, with which it does not hang
  double around = 0;               // px; width of the squares that are surroundings
  std::int64_t fewest_around = 0;  // points that these take
};

// Of each point, the number of its observations in which it hangs, nearly alone, before what others
// show in the same square of the image. Rays and points that are not finite tell nothing. Throws
// for squares without a width, too.
std::vector<std::int64_t> hanging_observations(const SeenPoints& points,
                                               const HangingOptions& options);

}  // namespace colmap_av1::geometry
