#include "geometry/points.h"

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <numeric>
#include <stdexcept>

#include "geometry/geometry.h"

namespace colmap_av1::geometry {
namespace {

// Throws for inconsistent points, observations and views.
void check_rows(std::size_t num_points, std::span<const std::int64_t> offsets, std::size_t total) {
  if (offsets.size() != num_points + 1 || offsets.front() != 0 ||
      offsets.back() != static_cast<std::int64_t>(total) ||
      !std::is_sorted(offsets.begin(), offsets.end())) {
    throw std::invalid_argument("points, offsets and observations do not fit each other");
  }
}

void check_indices(std::span<const std::int64_t> indices, std::size_t size) {
  const auto is_out = [size](std::int64_t i) {
    return i < 0 || i >= static_cast<std::int64_t>(size);
  };
  if (std::any_of(indices.begin(), indices.end(), is_out)) {
    throw std::invalid_argument("there is no such view or observation");
  }
}

void check(const ObservedPoints& points) {
  const std::size_t num_views = points.cam_from_world.size() / 12;
  if (points.focal.size() != 2 * num_views || points.rays.size() != 2 * points.view.size()) {
    throw std::invalid_argument("poses, focal lengths, views and rays do not fit each other");
  }
  check_rows(points.xyz.size() / 3, points.offsets, points.observation.size());
  check_indices(points.view, num_views);
  check_indices(points.observation, points.view.size());
}

// An observation of a point: its square in the image, and its distance from the camera.
struct InSquare {
  double row = 0;  // an integer, like the column
  double column = 0;
  double distance = 0;
  std::int64_t point = 0;
};

// Counts the floaters among the points of one square, which are reordered.
void count_floaters(std::span<InSquare> square, const FloaterOptions& options,
                    std::vector<std::int64_t>& counts) {
  if (static_cast<std::int64_t>(square.size()) < options.fewest_in_square) return;
  const auto middle = square.begin() + static_cast<std::ptrdiff_t>(square.size() / 2);
  std::nth_element(square.begin(), middle, square.end(),
                   [](const InSquare& a, const InSquare& b) { return a.distance < b.distance; });
  const double limit = options.distance_share * middle->distance;
  // After nth_element, points nearer than the median come before it.
  for (const InSquare& own : std::span(square.begin(), middle)) {
    if (!(own.distance < limit)) continue;
    const auto near = std::count_if(square.begin(), square.end(), [&](const InSquare& other) {
      return other.distance <= own.distance * options.near_ratio &&
             other.distance * options.near_ratio >= own.distance;
    });
    if (near < options.support) ++counts[static_cast<std::size_t>(own.point)];
  }
}

// The observations of points, sorted by view.
struct ByViews {
  struct Seen {
    std::int64_t point = 0;
    std::int64_t observation = 0;
  };
  std::vector<Seen> seen;
  std::vector<std::int64_t> bounds;  // view v has observations bounds[v] to bounds[v + 1] - 1
};

ByViews order_by_views(const ObservedPoints& points, std::size_t num_views) {
  ByViews out;
  out.bounds.resize(num_views + 1);
  const auto view_of = [&](std::int64_t i) {
    return static_cast<std::size_t>(points.view[static_cast<std::size_t>(i)]);
  };
  for (const std::int64_t i : points.observation) ++out.bounds[view_of(i) + 1];
  std::partial_sum(out.bounds.begin(), out.bounds.end(), out.bounds.begin());
  out.seen.resize(points.observation.size());
  std::vector<std::int64_t> next(out.bounds.begin(), out.bounds.end() - 1);
  for (std::size_t point = 0; point + 1 < points.offsets.size(); ++point) {
    const auto last = static_cast<std::size_t>(points.offsets[point + 1]);
    for (auto i = static_cast<std::size_t>(points.offsets[point]); i < last; ++i) {
      const std::int64_t own = points.observation[i];
      const auto place = static_cast<std::size_t>(next[view_of(own)]++);
      out.seen[place] = {static_cast<std::int64_t>(point), own};
    }
  }
  return out;
}

}  // namespace

std::vector<double> reprojection_errors(const ObservedPoints& points) {
  check(points);
  std::vector<double> errors(points.observation.size());
  for (std::size_t point = 0; point + 1 < points.offsets.size(); ++point) {
    const auto last = static_cast<std::size_t>(points.offsets[point + 1]);
    for (auto i = static_cast<std::size_t>(points.offsets[point]); i < last; ++i) {
      const auto seen = static_cast<std::size_t>(points.observation[i]);
      const auto view = static_cast<std::size_t>(points.view[seen]);
      const double* ray = points.rays.data() + 2 * seen;
      const Projection found =
          project(points.cam_from_world.data() + 12 * view, points.focal.data() + 2 * view, ray[0],
                  ray[1], points.xyz.data() + 3 * point);
      errors[i] = std::sqrt(found.error2);
    }
  }
  return errors;
}

std::vector<double> widest_angles(std::span<const double> centres, std::span<const double> xyz,
                                  std::span<const std::int64_t> offsets,
                                  std::span<const std::int64_t> view) {
  check_rows(xyz.size() / 3, offsets, view.size());
  check_indices(view, centres.size() / 3);
  std::vector<double> angles(xyz.size() / 3);
  for (std::size_t point = 0; point < angles.size(); ++point) {
    const std::int64_t begin = offsets[point];
    const auto count = static_cast<std::size_t>(offsets[point + 1] - begin);
    angles[point] = widest_angle(count, [&](std::size_t i) {
      const std::int64_t own = 3 * view[static_cast<std::size_t>(begin) + i];
      return unit_vector(centres.data() + own, xyz.data() + 3 * point);
    });
  }
  return angles;
}

std::vector<std::int64_t> floater_observations(const ObservedPoints& points,
                                               const FloaterOptions& options) {
  check(points);
  if (!(options.square_width > 0)) throw std::invalid_argument("squares are wider than 0");
  const std::size_t num_views = points.cam_from_world.size() / 12;
  const ByViews by_views = order_by_views(points, num_views);
  std::vector<std::int64_t> counts(points.xyz.size() / 3);
  std::vector<InSquare> seen;
  for (std::size_t view = 0; view < num_views; ++view) {
    const Vector centre = camera_centre(points.cam_from_world.data() + 12 * view);
    const double* focal = points.focal.data() + 2 * view;
    seen.clear();
    for (std::int64_t i = by_views.bounds[view]; i < by_views.bounds[view + 1]; ++i) {
      const auto [point, observation] = by_views.seen[static_cast<std::size_t>(i)];
      const double* ray = points.rays.data() + 2 * observation;
      const InSquare own{.row = std::floor(ray[1] * focal[1] / options.square_width),
                         .column = std::floor(ray[0] * focal[0] / options.square_width),
                         .distance = length(between(centre.data(), points.xyz.data() + 3 * point)),
                         .point = point};
      // NaN cannot be sorted.
      if (std::isfinite(own.row) && std::isfinite(own.column) && std::isfinite(own.distance)) {
        seen.push_back(own);
      }
    }
    std::sort(seen.begin(), seen.end(), [](const InSquare& a, const InSquare& b) {
      return a.row != b.row ? a.row < b.row : a.column < b.column;
    });
    for (auto first = seen.begin(); first != seen.end();) {
      const auto beyond = std::find_if(first, seen.end(), [&](const InSquare& other) {
        return other.row != first->row || other.column != first->column;
      });
      count_floaters({first, beyond}, options, counts);
      first = beyond;
    }
  }
  return counts;
}

}  // namespace colmap_av1::geometry
