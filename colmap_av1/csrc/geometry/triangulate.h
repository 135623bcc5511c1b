// Robust triangulation of tracks with known poses, track by track.
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
  std::optional<double> max_depth_error;  // as a share of the distance
  double sigma_floor = 0;                 // px; smallest error of an observation
  double error_to_sigma = 0;  // ratio of the error of rays to a point's mean reprojection error
};

// A view of posed images and the tracks observed in them, in compressed sparse row form.
struct PosedTracks {
  std::span<const double> cam_from_world;  // [num_views][3][4]
  std::span<const double> focal;           // [num_views][2]; converts errors to pixels
  std::span<const std::int64_t> offsets;   // [num_tracks + 1]
  std::span<const std::int64_t> view;      // of each observation; by time within a track
  std::span<const double> rays;            // [num_observations][2], (x / z, y / z) in the camera
  std::span<const float> sigma;            // [num_observations] expected errors in pixels
};

struct PointArrays {
  std::vector<double> xyz;                // [num_points][3]
  std::vector<double> error;              // mean reprojection error in pixels
  std::vector<std::int64_t> count;        // number of observations of each point
  std::vector<std::int64_t> observation;  // indices of the observations, point by point
  std::int64_t num_agreeing = 0;  // number of tracks with enough observations that fit the poses
  std::int64_t num_tracks = 0;    // number of tracks with enough observations
};

// Triangulates the tracks from `first` up to but excluding `last`. The initial value of a point is
// the best of several midpoints of two rays (Hartley and Sturm, "Triangulation", 1997), judged by
// all observations. It is refined by Gauss-Newton steps on the weighted reprojection error. A track
// that slid from one surface to another observes two points, so its outliers are triangulated as
// well. Rays that are not finite are ignored. Throws std::invalid_argument for inconsistent arrays.
PointArrays triangulate(const PosedTracks& tracks, std::int64_t first, std::int64_t last,
                        const TriangulateOptions& options);

}  // namespace colmap_av1::geometry
