#include "geometry/surfaces.h"

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <limits>
#include <stdexcept>

namespace colmap_av1::geometry {
namespace {

void check(std::span<const double> xy, std::span<const double> depth,
           std::span<const std::int64_t> rank, std::int64_t width, std::int64_t height,
           const SurfaceOptions& options) {
  if (xy.size() != 2 * depth.size() || rank.size() != depth.size()) {
    throw std::invalid_argument("xy, depth and rank do not fit each other");
  }
  for (std::size_t i = 0; i < depth.size(); ++i) {
    const double x = xy[2 * i];
    const double y = xy[2 * i + 1];
    if (!(x >= 0 && x < static_cast<double>(width) && y >= 0 && y < static_cast<double>(height) &&
          depth[i] > 0 && std::isfinite(depth[i]))) {
      throw std::invalid_argument("a point lies outside the picture, behind it or without end");
    }
  }
  if (options.most_steps < 1 ||
      !std::all_of(
          options.spacings.begin(), options.spacings.end(), [](std::int64_t s) { return s > 0; })) {
    throw std::invalid_argument("spacings and steps are 1 or more");
  }
}

// Number of depth steps of each point beyond the nearest point.
std::vector<std::int64_t> steps_of(std::span<const double> depth, const SurfaceOptions& options) {
  std::vector<double> steps(depth.size());
  double least = std::numeric_limits<double>::infinity();
  for (std::size_t i = 0; i < depth.size(); ++i) {
    steps[i] = std::floor(options.steps_per_octave * std::log2(depth[i]));
    least = std::min(least, steps[i]);
  }
  // NaN, from an overflow of steps, counts as the last step.
  const auto last = static_cast<double>(options.most_steps - 1);
  std::vector<std::int64_t> found(depth.size());
  std::transform(steps.begin(), steps.end(), found.begin(), [&](double step) {
    const double beyond = step - least;
    return static_cast<std::int64_t>(beyond < last ? beyond : last);
  });
  return found;
}

}  // namespace

std::vector<std::int64_t> best_at_spacings(std::span<const double> xy,
                                           std::span<const double> depth,
                                           std::span<const std::int64_t> rank, std::int64_t width,
                                           std::int64_t height, const SurfaceOptions& options) {
  check(xy, depth, rank, width, height, options);
  const std::vector<std::int64_t> steps = steps_of(depth, options);
  const std::size_t num_spacings = options.spacings.size();
  std::vector<std::int64_t> found(depth.size(), static_cast<std::int64_t>(num_spacings));
  std::vector<std::int64_t> best;
  std::vector<std::size_t> cells(depth.size());
  for (std::size_t number = num_spacings; number-- > 0;) {
    const std::int64_t spacing = options.spacings[number];
    const std::int64_t columns = (width + spacing - 1) / spacing;
    const std::int64_t rows = (height + spacing - 1) / spacing;
    best.assign(static_cast<std::size_t>(rows * columns * options.most_steps),
                std::numeric_limits<std::int64_t>::max());
    for (std::size_t i = 0; i < depth.size(); ++i) {
      const std::int64_t column = static_cast<std::int64_t>(xy[2 * i]) / spacing;
      const std::int64_t row = static_cast<std::int64_t>(xy[2 * i + 1]) / spacing;
      const std::int64_t cell = (row * columns + column) * options.most_steps + steps[i];
      cells[i] = static_cast<std::size_t>(cell);
      best[cells[i]] = std::min(best[cells[i]], rank[i]);
    }
    for (std::size_t i = 0; i < depth.size(); ++i) {
      if (best[cells[i]] == rank[i]) found[i] = static_cast<std::int64_t>(number);
    }
  }
  return found;
}

}  // namespace colmap_av1::geometry
