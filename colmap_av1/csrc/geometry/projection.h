// Points of the world in the pictures of posed cameras.
#pragma once

#include <cstdint>
#include <span>
#include <vector>

namespace colmap_av1::geometry {

// A pinhole camera's pixels: the first one's centre is at (0.5, 0.5).
struct Pinhole {
  double focal_x = 0;
  double focal_y = 0;
  double centre_x = 0;
  double centre_y = 0;
  double width = 0;
  double height = 0;
};

// Least and largest rays (x / z, y / z) that a camera sees.
struct RayBounds {
  double low_x = 0;
  double low_y = 0;
  double high_x = 0;
  double high_y = 0;
};

// Points that a picture may show, ascending.
struct PointsInView {
  std::vector<std::int64_t> index;
  std::vector<double> xyz;  // [n][3] in the camera
};

// Points that a picture shows, ascending.
struct PointsInPicture {
  std::vector<std::int64_t> index;
  std::vector<double> xy;     // [n][2] pixels
  std::vector<double> depth;  // along the camera's axis
};

// The points before a camera whose rays lie within bounds. The pose is [3][4], x_cam = R x + t,
// points are [n][3].
PointsInView points_in_view(std::span<const double, 12> cam_from_world, const RayBounds& bounds,
                            std::span<const double> xyz);

// The points that lie in a pinhole camera's picture.
PointsInPicture points_in_picture(std::span<const double, 12> cam_from_world, const Pinhole& camera,
                                  std::span<const double> xyz);

// Least of the depths [n] at pixels [n][2] in each of the cells, so many pixels wide, that cover
// a picture: [rows][columns], infinite where there is none. What lies beyond the edge is of the
// cell there. Throws std::invalid_argument for arrays that do not fit.
std::vector<double> nearest_in_cells(std::span<const double> xy, std::span<const double> depth,
                                     int cell, std::int64_t columns, std::int64_t rows);

}  // namespace colmap_av1::geometry
