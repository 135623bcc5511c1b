#include "model/points.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <limits>
#include <numeric>
#include <stdexcept>

namespace colmap_av1::model {
namespace {

using Vector = std::array<double, 3>;

// Least length of a ray that is divided by.
constexpr double kTiny = 1e-12;

// Throws for points, rows of observations and views that do not fit each other.
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

void check(const SeenPoints& points) {
  const std::size_t num_views = points.cam_from_world.size() / 12;
  if (points.focal.size() != 2 * num_views || points.rays.size() != 2 * points.view.size()) {
    throw std::invalid_argument("poses, focal lengths, views and rays do not fit each other");
  }
  check_rows(points.xyz.size() / 3, points.offsets, points.observation.size());
  check_indices(points.view, num_views);
  check_indices(points.observation, points.view.size());
}

std::vector<Vector> camera_centres(std::span<const double> poses) {
  std::vector<Vector> centres(poses.size() / 12);
  for (std::size_t view = 0; view < centres.size(); ++view) {
    const double* pose = poses.data() + 12 * view;
    for (std::size_t i = 0; i < 3; ++i) {
      centres[view][i] = -(pose[i] * pose[3] + pose[4 + i] * pose[7] + pose[8 + i] * pose[11]);
    }
  }
  return centres;
}

Vector between(const double* point, const double* centre) {
  return {point[0] - centre[0], point[1] - centre[1], point[2] - centre[2]};
}

double dot(const Vector& a, const Vector& b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }

Vector unit(const Vector& ray) {
  const double length = std::max(std::sqrt(dot(ray, ray)), kTiny);
  return {ray[0] / length, ray[1] / length, ray[2] / length};
}

double error_of(const double* pose, const double* focal, const double* ray, const double* point) {
  Vector local{};
  for (std::size_t i = 0; i < 3; ++i) {
    const double* row = pose + 4 * i;
    local[i] = row[0] * point[0] + row[1] * point[1] + row[2] * point[2] + row[3];
  }
  const double x = (local[0] / local[2] - ray[0]) * focal[0];
  const double y = (local[1] / local[2] - ray[1]) * focal[1];
  const double error = std::sqrt(x * x + y * y);
  return local[2] > 0 && std::isfinite(error) ? error : std::numeric_limits<double>::infinity();
}

// A point in an image: in which square, and how far from the camera.
struct InSquare {
  double row = 0;  // whole numbers, as the column
  double column = 0;
  double distance = 0;
  std::int64_t point = 0;
};

// Counts the points that hang among those of one square; their order is changed.
void count_hanging(std::span<InSquare> square, const HangingOptions& options,
                   std::vector<std::int64_t>& counts) {
  if (static_cast<std::int64_t>(square.size()) < options.fewest_around) return;
  const auto middle = square.begin() + static_cast<std::ptrdiff_t>(square.size() / 2);
  std::nth_element(square.begin(), middle, square.end(),
                   [](const InSquare& a, const InSquare& b) { return a.distance < b.distance; });
  const double limit = options.before * middle->distance;
  // What is nearer than the middle one lies before it now.
  for (const InSquare& own : std::span(square.begin(), middle)) {
    if (!(own.distance < limit)) continue;
    const auto near = std::count_if(square.begin(), square.end(), [&](const InSquare& other) {
      return other.distance <= own.distance * options.as_near &&
             other.distance * options.as_near >= own.distance;
    });
    if (near < options.support) ++counts[static_cast<std::size_t>(own.point)];
  }
}

// The observations of points, one view after the other.
struct ByViews {
  struct Seen {
    std::int64_t point = 0;
    std::int64_t observation = 0;
  };
  std::vector<Seen> seen;
  std::vector<std::int64_t> ends;  // view v has those from ends[v] to before ends[v + 1]
};

ByViews order_by_views(const SeenPoints& points, std::size_t num_views) {
  ByViews out;
  out.ends.resize(num_views + 1);
  const auto view_of = [&](std::int64_t i) {
    return static_cast<std::size_t>(points.view[static_cast<std::size_t>(i)]);
  };
  for (const std::int64_t i : points.observation) ++out.ends[view_of(i) + 1];
  std::partial_sum(out.ends.begin(), out.ends.end(), out.ends.begin());
  out.seen.resize(points.observation.size());
  std::vector<std::int64_t> next(out.ends.begin(), out.ends.end() - 1);
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

std::vector<double> reprojection_errors(const SeenPoints& points) {
  check(points);
  std::vector<double> errors(points.observation.size());
  for (std::size_t point = 0; point + 1 < points.offsets.size(); ++point) {
    const auto last = static_cast<std::size_t>(points.offsets[point + 1]);
    for (auto i = static_cast<std::size_t>(points.offsets[point]); i < last; ++i) {
      const auto seen = static_cast<std::size_t>(points.observation[i]);
      const auto view = static_cast<std::size_t>(points.view[seen]);
      errors[i] = error_of(points.cam_from_world.data() + 12 * view, points.focal.data() + 2 * view,
                           points.rays.data() + 2 * seen, points.xyz.data() + 3 * point);
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
    const auto ray = [&](std::int64_t i) {
      const std::int64_t own = 3 * view[static_cast<std::size_t>(i)];
      return unit(between(xyz.data() + 3 * point, centres.data() + own));
    };
    const std::int64_t begin = offsets[point];
    const std::int64_t end = offsets[point + 1];
    if (begin == end) continue;
    const Vector first = ray(begin);
    const Vector last = ray(end - 1);
    double narrowest = 1.0;
    for (std::int64_t i = begin; i < end; ++i) {
      const Vector own = ray(i);
      narrowest = std::min({narrowest, dot(own, first), dot(own, last)});
    }
    angles[point] = std::acos(std::clamp(narrowest, -1.0, 1.0));
  }
  return angles;
}

std::vector<std::int64_t> hanging_observations(const SeenPoints& points,
                                               const HangingOptions& options) {
  check(points);
  const std::vector<Vector> centres = camera_centres(points.cam_from_world);
  const ByViews by_views = order_by_views(points, centres.size());
  std::vector<std::int64_t> counts(points.xyz.size() / 3);
  std::vector<InSquare> seen;
  for (std::size_t view = 0; view < centres.size(); ++view) {
    seen.clear();
    for (std::int64_t i = by_views.ends[view]; i < by_views.ends[view + 1]; ++i) {
      const auto [point, observation] = by_views.seen[static_cast<std::size_t>(i)];
      const Vector ray = between(points.xyz.data() + 3 * point, centres[view].data());
      const double* seen_at = points.rays.data() + 2 * static_cast<std::size_t>(observation);
      const auto square = [&](std::size_t axis) {
        return std::floor(seen_at[axis] * points.focal[2 * view + axis] / options.around);
      };
      seen.push_back({square(1), square(0), std::sqrt(dot(ray, ray)), point});
    }
    std::sort(seen.begin(), seen.end(), [](const InSquare& a, const InSquare& b) {
      return a.row != b.row ? a.row < b.row : a.column < b.column;
    });
    for (auto first = seen.begin(); first != seen.end();) {
      const auto beyond = std::find_if(first, seen.end(), [&](const InSquare& other) {
        return other.row != first->row || other.column != first->column;
      });
      count_hanging({first, beyond}, options, counts);
      first = beyond;
    }
  }
  return counts;
}

}  // namespace colmap_av1::model
