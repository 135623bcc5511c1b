// Passes arbitrary numbers as points, cameras and pictures, as a caller of the Python module could.
// Inconsistent arrays must be rejected, and results must lie within their bounds.

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <limits>
#include <span>
#include <stdexcept>
#include <vector>

#include "fuzz/input.h"
#include "geometry/patch_search.h"
#include "geometry/patches.h"
#include "geometry/points.h"
#include "geometry/projection.h"
#include "geometry/surfaces.h"
#include "geometry/triangulate.h"

namespace {

using colmap_av1::fuzz::check;
using colmap_av1::fuzz::Input;
namespace geometry = colmap_av1::geometry;

using Doubles = std::vector<double>;
using Indices = std::vector<std::int64_t>;

// Numbers near 0, like rays and positions, and numbers at the limits of arithmetic.
double real(Input& input) {
  constexpr double kLargest = std::numeric_limits<double>::max();
  constexpr std::array<double, 6> kEdges{
      std::numeric_limits<double>::quiet_NaN(),  std::numeric_limits<double>::infinity(),
      -std::numeric_limits<double>::infinity(),  kLargest,
      std::numeric_limits<double>::denorm_min(), -0.0};
  const std::uint8_t choice = input.byte();
  return choice < kEdges.size() ? kEdges[choice] : (static_cast<double>(choice) - 128) / 16;
}

Doubles reals(Input& input, std::size_t count) {
  Doubles found(count);
  for (double& value : found) value = real(input);
  return found;
}

// An index that is sometimes out of range by one, at either end.
Indices indices(Input& input, std::size_t count, std::size_t size) {
  Indices found(count);
  for (std::int64_t& value : found) {
    const std::uint8_t choice = input.byte();
    value = choice == 255 ? -1 : choice % static_cast<std::int64_t>(size + (choice == 254) + 1);
    if (choice < 254 && size > 0) value = choice % static_cast<std::int64_t>(size);
  }
  return found;
}

// Offsets of rows, which are nearly always in order.
Indices offsets(Input& input, std::size_t count, std::size_t total) {
  Indices found(count + 1);
  for (std::int64_t& value : found) value = input.byte() % static_cast<std::int64_t>(total + 1);
  if (input.byte() != 255) std::sort(found.begin(), found.end());
  found.front() = 0;
  if (input.byte() != 255) found.back() = static_cast<std::int64_t>(total);
  return found;
}

// Calls a function of the core, which may reject its input.
template <typename Call>
void refused_or(const Call& call) {
  try {
    call();
  } catch (const std::invalid_argument&) {
  }
}

void run_points(Input& input) {
  const std::size_t num_views = input.byte() % 5;
  const std::size_t num_points = input.byte() % 9;
  const std::size_t num_seen = input.byte() % 33;
  const Doubles poses = reals(input, 12 * num_views);
  const Doubles focal = reals(input, 2 * num_views);
  const Indices view = indices(input, num_seen, num_views);
  const Doubles rays = reals(input, 2 * num_seen);
  const Doubles xyz = reals(input, 3 * num_points);
  const Indices observation = indices(input, num_seen, num_seen);
  const Indices rows = offsets(input, num_points, num_seen);
  const geometry::ObservedPoints points{.cam_from_world = poses,
                                        .focal = focal,
                                        .view = view,
                                        .rays = rays,
                                        .xyz = xyz,
                                        .offsets = rows,
                                        .observation = observation};
  refused_or([&] {
    const Doubles errors = geometry::reprojection_errors(points);
    check(errors.size() == num_seen &&
              std::all_of(errors.begin(), errors.end(), [](double e) { return e >= 0; }),
          "errors are numbers");
  });
  refused_or([&] {
    const Indices counts =
        geometry::floater_observations(points, {.distance_share = real(input),
                                                .near_ratio = real(input),
                                                .support = input.byte() % 5,
                                                .square_width = real(input),
                                                .fewest_in_square = input.byte() % 9});
    for (std::size_t i = 0; i < counts.size(); ++i) {
      check(counts[i] >= 0 && counts[i] <= rows[i + 1] - rows[i],
            "counts are at most the observations of the point");
    }
  });
  refused_or([&] {
    const Doubles angles =
        geometry::widest_angles(std::span(poses).first(3 * num_views), xyz, rows, view);
    check(std::all_of(angles.begin(), angles.end(), [](double a) { return a >= 0 && a < 3.2; }),
          "angles are at most half a turn");
  });
  std::vector<float> sigma(num_seen);
  for (float& value : sigma) value = static_cast<float>(input.byte()) / 16.F;
  refused_or([&] {
    const geometry::PosedTracks tracks{.cam_from_world = poses,
                                       .focal = focal,
                                       .offsets = rows,
                                       .view = view,
                                       .rays = rays,
                                       .sigma = sigma};
    const auto found = geometry::triangulate(
        tracks, 0, static_cast<std::int64_t>(num_points),
        {.min_observations = input.byte() % 4, .max_reprojection_error = real(input)});
    check(found.xyz.size() == 3 * found.error.size() && found.count.size() == found.error.size(),
          "points have places and errors");
    for (const std::int64_t i : found.observation) {
      check(i >= 0 && i < static_cast<std::int64_t>(num_seen), "points have observations");
    }
  });
}

void run_pictures(Input& input) {
  const std::size_t num_points = input.byte();
  const Doubles numbers = reals(input, 12 + 4 + 3 * num_points);
  const auto pose = std::span(numbers).first<12>();
  const auto given = std::span(numbers).subspan(12, 4);
  const auto xyz = std::span(numbers).subspan(16);
  const auto in_view = geometry::points_in_view(
      pose, {.low_x = given[0], .low_y = given[1], .high_x = given[2], .high_y = given[3]}, xyz);
  check(in_view.xyz.size() == 3 * in_view.index.size() && in_view.index.size() <= num_points,
        "points in view are some of all");
  const std::int64_t width = input.byte();
  const std::int64_t height = input.byte();
  const auto shown = geometry::points_in_picture(pose,
                                                 {.focal_x = given[0],
                                                  .focal_y = given[1],
                                                  .centre_x = given[2],
                                                  .centre_y = given[3],
                                                  .width = static_cast<double>(width),
                                                  .height = static_cast<double>(height)},
                                                 xyz);
  const auto beyond = std::span(numbers).first(2 * (numbers.size() / 2));
  const auto depths = std::span(numbers).first(numbers.size() / 2);
  const int cell = input.byte() % 20;
  refused_or([&] {
    const std::int64_t columns = input.byte() % 20;
    const auto nearest = geometry::nearest_in_cells(beyond, depths, cell, columns, 7);
    check(nearest.size() == static_cast<std::size_t>(7 * columns), "all cells have depths");
  });
  Indices rank(shown.depth.size());
  for (std::size_t i = 0; i < rank.size(); ++i) rank[i] = static_cast<std::int64_t>(i);
  const Indices spacings{16, 4, input.byte() % 4};
  const geometry::SurfaceOptions options{
      .spacings = spacings, .steps_per_octave = real(input), .most_steps = input.byte() % 40};
  refused_or([&] {
    const Indices stages =
        geometry::best_at_spacings(shown.xy, shown.depth, rank, width, height, options);
    // The first point has the best rank, so it is selected wherever it is.
    check(stages.empty() || stages.front() == 0, "the best point is wanted first");
  });
  rank.resize(depths.size());
  refused_or([&] { geometry::best_at_spacings(beyond, depths, rank, width, height, options); });
}

void run_patches(Input& input) {
  const std::int64_t width = input.byte() % 24;
  const std::int64_t height = input.byte() % 24;
  std::vector<std::uint8_t> pixels(static_cast<std::size_t>(width * height));
  for (std::uint8_t& pixel : pixels) pixel = input.byte();
  const geometry::GreyPicture picture{.pixels = pixels, .width = width, .height = height};
  std::vector<float> places(2 * (input.byte() % 9));
  for (float& at : places) at = static_cast<float>(2 * real(input));
  refused_or([&] {
    const auto one = std::span(places).first(places.size() / 4 * 2);
    const auto two = std::span(places).subspan(one.size());
    const auto found =
        geometry::correlate_patches(picture, one, picture, two, static_cast<float>(real(input)));
    check(std::all_of(found.begin(), found.end(),
                      [](float value) { return std::abs(value) < 1.001F; }),
          "correlations are at most 1");
  });
  const std::size_t num_sought = places.size() / 2;
  const Indices index = indices(input, num_sought, pixels.empty() ? 0 : 1);
  std::vector<float> change(4 * num_sought);
  for (float& value : change) value = static_cast<float>(real(input));
  // A square picture is its own patch, so that something is found.
  const geometry::CutPatches patches{
      .pixels = pixels, .side = width, .index = index, .middle = places, .change = change};
  const auto max_move = static_cast<float>(real(input));
  refused_or([&] {
    const auto found = geometry::find_patches(patches, picture, places, max_move);
    for (std::size_t i = 0; i < num_sought; ++i) {
      const bool is_found = std::isfinite(found.forward_backward_error[i]);
      check(found.forward_backward_error[i] >= 0 && std::abs(found.correlation[i]) < 1.001F,
            "patches are compared");
      check(!is_found || (std::abs(found.xy[2 * i] - places[2 * i]) <= max_move &&
                          std::abs(found.xy[2 * i + 1] - places[2 * i + 1]) <= max_move),
            "patches are found near their start");
    }
  });
}

}  // namespace

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* data, std::size_t size) {
  Input input(data, size);
  switch (input.byte() % 3) {
    case 0: run_points(input); break;
    case 1: run_pictures(input); break;
    default: run_patches(input); break;
  }
  return 0;
}
