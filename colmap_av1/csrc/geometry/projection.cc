#include "geometry/projection.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <limits>
#include <stdexcept>

#include "geometry/geometry.h"

namespace colmap_av1::geometry {
namespace {

// Number of points that are processed at a time.
constexpr std::size_t kChunk = 1024;

template <typename T, std::size_t size>
void append(const std::array<T, size>& from, std::size_t count, std::vector<T>& to) {
  to.insert(to.end(), from.begin(), from.begin() + static_cast<std::ptrdiff_t>(count));
}

// Processes points in chunks. `write` gets an index in the chunk and a point in camera coordinates,
// writes its values at that index, and returns whether it is visible. `take` then takes the first
// values of the chunk. Every point is written, and an invisible one is overwritten by the next:
// this has no branches, because visibility is too random for branch prediction.
template <typename Write, typename Take>
void visit_visible(std::span<const double, 12> cam_from_world, std::span<const double> xyz,
                   std::vector<std::int64_t>& seen, const Write& write, const Take& take) {
  const std::size_t total = xyz.size() / 3;
  std::array<std::int64_t, kChunk> index;
  for (std::size_t first = 0; first < total; first += kChunk) {
    std::size_t count = 0;
    for (std::size_t i = first; i < std::min(first + kChunk, total); ++i) {
      index[count] = static_cast<std::int64_t>(i);
      count += write(count, to_camera(cam_from_world.data(), xyz.data() + 3 * i)) ? 1 : 0;
    }
    append(index, count, seen);
    take(count);
  }
}

}  // namespace

PointsInView points_in_view(std::span<const double, 12> cam_from_world, const RayBounds& bounds,
                            std::span<const double> xyz) {
  PointsInView found;
  std::array<double, 3 * kChunk> local;
  visit_visible(
      cam_from_world, xyz, found.index,
      [&](std::size_t place, const Vector& at) {
        std::copy(at.begin(), at.end(), local.begin() + static_cast<std::ptrdiff_t>(3 * place));
        const auto [x, y, z] = at;
        return (z > 0) & (x >= bounds.low_x * z) & (x <= bounds.high_x * z) &
               (y >= bounds.low_y * z) & (y <= bounds.high_y * z);
      },
      [&](std::size_t count) { append(local, 3 * count, found.xyz); });
  return found;
}

PointsInPicture points_in_picture(std::span<const double, 12> cam_from_world, const Pinhole& camera,
                                  std::span<const double> xyz) {
  PointsInPicture found;
  std::array<double, 3 * kChunk> local;
  std::array<double, 2 * kChunk> pixels;
  std::array<double, kChunk> depth;
  const double last_x = std::max(0.0, std::nextafter(camera.width, 0.0));
  const double last_y = std::max(0.0, std::nextafter(camera.height, 0.0));
  visit_visible(
      cam_from_world, xyz, found.index,
      [&](std::size_t place, const Vector& at) {
        std::copy(at.begin(), at.end(), local.begin() + static_cast<std::ptrdiff_t>(3 * place));
        // Pixels times depth are compared, because most points are invisible and a division takes
        // as long as everything else.
        const auto [u, v, z] = at;
        const double x = camera.focal_x * u + camera.centre_x * z;
        const double y = camera.focal_y * v + camera.centre_y * z;
        return (z > 0) & (x >= 0) & (x < camera.width * z) & (y >= 0) & (y < camera.height * z);
      },
      [&](std::size_t count) {
        for (std::size_t i = 0; i < count; ++i) {
          const double z = local[3 * i + 2];
          const double x = camera.focal_x * (local[3 * i] / z) + camera.centre_x;
          const double y = camera.focal_y * (local[3 * i + 1] / z) + camera.centre_y;
          // Rounding must not move points beyond the edge.
          pixels[2 * i] = std::clamp(x, 0.0, last_x);
          pixels[2 * i + 1] = std::clamp(y, 0.0, last_y);
          depth[i] = z;
        }
        append(pixels, 2 * count, found.xy);
        append(depth, count, found.depth);
      });
  return found;
}

std::vector<double> nearest_in_cells(std::span<const double> xy, std::span<const double> depth,
                                     int cell, std::int64_t columns, std::int64_t rows) {
  if (xy.size() != 2 * depth.size() || cell < 1 || columns < 1 || rows < 1) {
    throw std::invalid_argument("xy, depth and cells do not fit each other");
  }
  std::vector<double> nearest(static_cast<std::size_t>(columns * rows),
                              std::numeric_limits<double>::infinity());
  // Points before the first cell, and NaN, count for the first cell.
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

}  // namespace colmap_av1::geometry
