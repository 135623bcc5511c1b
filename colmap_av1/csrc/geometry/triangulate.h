// 3D points of tracks on known poses: robust, one track after the other.
#pragma once

#include <cstdint>
#include <optional>
#include <span>
#include <vector>

namespace colmap_av1::geometry {

struct TriangulateOptions {
  int min_observations = 2;
  double max_reprojection_error = 0;      // px
  double min_angle = 0;                   // radians
  std::optional<double> max_depth_error;  // share of the distance
  double sigma_floor = 0;     // px; error that an observation has however accurate its motion is
  double error_to_sigma = 0;  // from a point's mean reprojection error to that of its rays
};

// Borrowed: posed images, and tracks that they see in compressed sparse row form.
struct PosedTracks {
  std::span<const double> cam_from_world;  // [num_views][3][4]
  std::span<const double> focal;           // [num_views][2]; turns errors into pixels
  std::span<const std::int64_t> offsets;   // [num_tracks + 1]
  std::span<const std::int64_t> view;      // of each observation; by time within a track
  std::span<const double> rays;            // [num_observations][2], (x / z, y / z) in the camera
  std::span<const float> sigma;            // [num_observations] expected errors in pixels
};

struct PointArrays {
  std::vector<double> xyz;                // [num_points][3]
  std::vector<double> error;              // mean reprojection error in pixels
  std::vector<std::int64_t> count;        // observations of each point
  std::vector<std::int64_t> observation;  // of one point after the other
  std::int64_t num_agreeing = 0;  // tracks of which enough observations agree with the poses
  std::int64_t num_tracks = 0;    // tracks that had enough observations
};

// Points of the tracks from `first` to before `last`, in their order. The first guess of a point is
// the best of several midpoints of two rays (Hartley and Sturm, "Triangulation", 1997), judged by
// all observations; Gauss-Newton steps on the weighted reprojection error follow. What is dropped
// may be a separate point, where a track slid from one surface to another: it is tried once more.
// Rays that are not finite are ignored. Throws std::invalid_argument for arrays that do not fit.
PointArrays triangulate(const PosedTracks& tracks, std::int64_t first, std::int64_t last,
                        const TriangulateOptions& options);

}  // namespace colmap_av1::geometry
