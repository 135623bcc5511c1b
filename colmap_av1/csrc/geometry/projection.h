// Projection of points into the pictures of posed cameras.
#pragma once

#include <cstdint>
#include <span>
#include <vector>

namespace colmap_av1::geometry {

// A pinhole camera; the centre of the first pixel is (0.5, 0.5).
struct Pinhole {
  double focal_x = 0;
  double focal_y = 0;
  double centre_x = 0;
  double centre_y = 0;
  double width = 0;
  double height = 0;
};

// Smallest and largest rays (x / z, y / z) in the field of view of a camera.
struct RayBounds {
  double low_x = 0;
  double low_y = 0;
  double high_x = 0;
  double high_y = 0;
};

// Points in the field of view of a camera, in ascending order of their indices.
struct PointsInView {
  std::vector<std::int64_t> index;
  std::vector<double> xyz;  // [n][3] in camera coordinates
};

// Points that project into a picture, in ascending order of their indices.
struct PointsInPicture {
  std::vector<std::int64_t> index;
  std::vector<double> xy;     // [n][2] pixels
  std::vector<double> depth;  // along the optical axis
};

// The points in front of a camera whose rays lie within bounds. The pose is [3][4], x_cam = R x +
// t; points are [n][3].
PointsInView points_in_view(std::span<const double, 12> cam_from_world, const RayBounds& bounds,
                            std::span<const double> xyz);

// The points that project into the picture of a pinhole camera.
PointsInPicture points_in_picture(std::span<const double, 12> cam_from_world, const Pinhole& camera,
                                  std::span<const double> xyz);

// Smallest of the depths [n] at pixels [n][2] in each cell of a picture: [rows][columns], infinite
// if there is none. Cells are `cell` pixels wide. Points beyond the edge count for the nearest
// cell. Throws std::invalid_argument for inconsistent arrays.
std::vector<double> nearest_in_cells(std::span<const double> xy, std::span<const double> depth,
                                     int cell, std::int64_t columns, std::int64_t rows);

}  // namespace colmap_av1::geometry
