// Points in the world and cameras that observe them. Poses are [3][4], x_cam = R x + t.
#pragma once

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <limits>

namespace colmap_av1::geometry {

using Vector = std::array<double, 3>;

inline double dot(const Vector& a, const Vector& b) {
  return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

inline double length(const Vector& a) { return std::sqrt(dot(a, a)); }

inline Vector between(const double* from, const double* to) {
  return {to[0] - from[0], to[1] - from[1], to[2] - from[2]};
}

// Unit vector from one point to another; 0 if they are equal.
inline Vector unit_vector(const double* from, const double* to) {
  Vector ray = between(from, to);
  const double norm = length(ray);
  if (norm > 0) {
    for (double& value : ray) value /= norm;
  }
  return ray;
}

// The position of the camera with a pose.
inline Vector camera_centre(const double* pose) {
  Vector centre{};
  for (std::size_t i = 0; i < 3; ++i) {
    centre[i] = -(pose[i] * pose[3] + pose[4 + i] * pose[7] + pose[8 + i] * pose[11]);
  }
  return centre;
}

// A point in camera coordinates.
inline Vector to_camera(const double* pose, const double* point) {
  Vector found{};
  for (std::size_t i = 0; i < 3; ++i) {
    const double* row = pose + 4 * i;
    found[i] = row[0] * point[0] + row[1] * point[1] + row[2] * point[2] + row[3];
  }
  return found;
}

// The projection of a point into a camera, and its reprojection error.
struct Projection {
  double x = 0;  // ray (x / z, y / z)
  double y = 0;
  double depth = 0;
  double error2 = std::numeric_limits<double>::infinity();  // px^2; infinite behind the camera
};

// Projects a point that is observed at a ray (x, y); focal lengths convert errors to pixels.
inline Projection project(const double* pose, const double* focal, double x, double y,
                          const double* point) {
  const auto [u, v, depth] = to_camera(pose, point);
  Projection found;
  found.depth = depth;
  if (!(depth > 0)) return found;
  found.x = u / depth;
  found.y = v / depth;
  const double residual_x = (found.x - x) * focal[0];
  const double residual_y = (found.y - y) * focal[1];
  const double error2 = residual_x * residual_x + residual_y * residual_y;
  if (std::isfinite(error2)) found.error2 = error2;
  return found;
}

// Triangulation angle in radians of rays, of which `ray_of` gives unit vectors by index. Only
// angles to the first and the last ray are compared, so the result can be slightly less than the
// largest angle. 0 for rays that are not finite.
template <typename RayOf>
double widest_angle(std::size_t count, const RayOf& ray_of) {
  if (count == 0) return 0;
  const Vector first = ray_of(0);
  const Vector last = ray_of(count - 1);
  double min_cosine = 1.0;
  for (std::size_t i = 0; i < count; ++i) {
    const Vector own = ray_of(i);
    min_cosine = std::min({min_cosine, dot(own, first), dot(own, last)});
  }
  return std::acos(std::clamp(min_cosine, -1.0, 1.0));
}

}  // namespace colmap_av1::geometry
