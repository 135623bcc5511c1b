#include "model/projection.h"

#include <algorithm>
#include <array>
#include <cstddef>
#include <limits>
#include <stdexcept>

namespace colmap_av1::model {
namespace {

// Points worked on at a time.
constexpr std::size_t kChunk = 1024;

using Vector = std::array<double, 3>;

Vector to_camera(std::span<const double, 12> pose, const double* point) {
  Vector found{};
  for (std::size_t i = 0; i < 3; ++i) {
    const double* row = pose.data() + 4 * i;
    found[i] = row[0] * point[0] + row[1] * point[1] + row[2] * point[2] + row[3];
  }
  return found;
}

template <typename T, std::size_t size>
void append(const std::array<T, size>& from, std::size_t count, std::vector<T>& to) {
  to.insert(to.end(), from.begin(), from.begin() + static_cast<std::ptrdiff_t>(count));
}

}  // namespace

// Here and below every point is written, and stays where the next one does not overwrite it: which
// ones are seen is too random for a processor to foretell.
PointsInView points_in_view(std::span<const double, 12> cam_from_world, const RayBounds& bounds,
                            std::span<const double> xyz) {
  const std::size_t total = xyz.size() / 3;
  PointsInView found;
  std::array<std::int64_t, kChunk> index;
  std::array<double, 3 * kChunk> local;
  for (std::size_t first = 0; first < total; first += kChunk) {
    std::size_t count = 0;
    for (std::size_t i = first; i < std::min(first + kChunk, total); ++i) {
      const Vector at = to_camera(cam_from_world, xyz.data() + 3 * i);
      const auto [x, y, z] = at;
      index[count] = static_cast<std::int64_t>(i);
      std::copy(at.begin(), at.end(), local.begin() + static_cast<std::ptrdiff_t>(3 * count));
      const bool within = (z > 0) & (x >= bounds.low_x * z) & (x <= bounds.high_x * z) &
                          (y >= bounds.low_y * z) & (y <= bounds.high_y * z);
      count += within ? 1 : 0;
    }
    append(index, count, found.index);
    append(local, 3 * count, found.xyz);
  }
  return found;
}

PointsInPicture points_in_picture(std::span<const double, 12> cam_from_world, const Pinhole& camera,
                                  std::span<const double> xyz) {
  const std::size_t total = xyz.size() / 3;
  PointsInPicture found;
  std::array<std::int64_t, kChunk> index;
  std::array<double, 2 * kChunk> pixels;
  std::array<double, kChunk> depth;
  for (std::size_t first = 0; first < total; first += kChunk) {
    std::size_t count = 0;
    for (std::size_t i = first; i < std::min(first + kChunk, total); ++i) {
      const auto [u, v, z] = to_camera(cam_from_world, xyz.data() + 3 * i);
      const double x = camera.focal_x * (u / z) + camera.centre_x;
      const double y = camera.focal_y * (v / z) + camera.centre_y;
      index[count] = static_cast<std::int64_t>(i);
      pixels[2 * count] = x;
      pixels[2 * count + 1] = y;
      depth[count] = z;
      const bool inside = (z > 0) & (x >= 0) & (x < camera.width) & (y >= 0) & (y < camera.height);
      count += inside ? 1 : 0;
    }
    append(index, count, found.index);
    append(pixels, 2 * count, found.xy);
    append(depth, count, found.depth);
  }
  return found;
}

std::vector<double> nearest_in_cells(std::span<const double> xy, std::span<const double> depth,
                                     int cell, std::int64_t columns, std::int64_t rows) {
  if (xy.size() != 2 * depth.size() || cell < 1 || columns < 1 || rows < 1) {
    throw std::invalid_argument("xy, depth and cells do not fit each other");
  }
  std::vector<double> nearest(static_cast<std::size_t>(columns * rows),
                              std::numeric_limits<double>::infinity());
  // Of what lies before the first cell, and what is no number, the first one.
  const auto place = [cell](double at, std::int64_t cells) {
    const double last = static_cast<double>(cells - 1);
    return at > 0 ? static_cast<std::int64_t>(std::min(at / cell, last)) : 0;
  };
  for (std::size_t i = 0; i < depth.size(); ++i) {
    const std::int64_t at = place(xy[2 * i + 1], rows) * columns + place(xy[2 * i], columns);
    double& least = nearest[static_cast<std::size_t>(at)];
    least = std::min(least, depth[i]);
  }
  return nearest;
}

}  // namespace colmap_av1::model
