// Python bindings of the geometry core: functions on arrays that release the GIL.

#include "bindings/geometry.h"

#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>

#include <cstddef>
#include <cstdint>
#include <optional>
#include <span>
#include <utility>
#include <vector>

#include "bindings/arrays.h"
#include "geometry/patch_search.h"
#include "geometry/patches.h"
#include "geometry/points.h"
#include "geometry/projection.h"
#include "geometry/surfaces.h"
#include "geometry/triangulate.h"

namespace nb = nanobind;
using namespace nb::literals;

namespace colmap_av1 {
namespace {

using Points = InputArray<double, nb::shape<-1, 3>>;
using Pose = InputArray<double, nb::shape<3, 4>>;
using Poses = InputArray<double, nb::shape<-1, 3, 4>>;
using Pairs = InputArray<double, nb::shape<-1, 2>>;
using Positions = InputArray<float, nb::shape<-1, 2>>;
using Numbers = InputArray<double, nb::ndim<1>>;
using Indices = InputArray<std::int64_t, nb::ndim<1>>;
using Picture = InputArray<std::uint8_t, nb::ndim<2>>;

template <typename Array>
auto span_of(const Array& array) {
  return std::span(array.data(), array.size());
}

std::span<const double, 12> span_of(const Pose& pose) {
  return std::span<const double, 12>(pose.data(), 12);
}

nb::tuple triangulate(const Poses& cam_from_world, const Pairs& focal, const Indices& offsets,
                      const Indices& view, const Pairs& rays,
                      const InputArray<float, nb::ndim<1>>& sigma, std::int64_t first,
                      std::int64_t last, int min_observations, double max_reprojection_error,
                      double min_angle, std::optional<double> max_depth_error, double sigma_floor,
                      double error_to_sigma) {
  const geometry::PosedTracks tracks{.cam_from_world = span_of(cam_from_world),
                                     .focal = span_of(focal),
                                     .offsets = span_of(offsets),
                                     .view = span_of(view),
                                     .rays = span_of(rays),
                                     .sigma = span_of(sigma)};
  geometry::PointArrays points;
  {
    const nb::gil_scoped_release release;
    points = geometry::triangulate(tracks, first, last,
                                   {.min_observations = min_observations,
                                    .max_reprojection_error = max_reprojection_error,
                                    .min_angle = min_angle,
                                    .max_depth_error = max_depth_error,
                                    .sigma_floor = sigma_floor,
                                    .error_to_sigma = error_to_sigma});
  }
  const std::size_t count = points.error.size();
  return nb::make_tuple(adopt<double>(std::move(points.xyz), {count, 3}),
                        adopt(std::move(points.error)), adopt(std::move(points.count)),
                        adopt(std::move(points.observation)), points.num_agreeing,
                        points.num_tracks);
}

geometry::GreyPicture grey_picture(const Picture& pixels) {
  return {.pixels = span_of(pixels),
          .width = static_cast<std::int64_t>(pixels.shape(1)),
          .height = static_cast<std::int64_t>(pixels.shape(0))};
}

nb::object correlate_patches(const Picture& one, const Positions& at_one, const Picture& two,
                             const InputArray<float, nb::shape<-1, -1, 2>>& at_two,
                             float min_deviation) {
  if (at_one.shape(0) != at_two.shape(0)) {
    throw nb::value_error("at_one and at_two are of different lengths");
  }
  std::vector<float> found;
  {
    const nb::gil_scoped_release release;
    found = geometry::correlate_patches(grey_picture(one), span_of(at_one), grey_picture(two),
                                        span_of(at_two), min_deviation);
  }
  return adopt<float>(std::move(found), {at_two.shape(0), at_two.shape(1)});
}

nb::tuple find_patches(const InputArray<std::uint8_t, nb::ndim<3>>& patches, const Indices& index,
                       const Positions& middle,
                       const InputArray<float, nb::shape<-1, 2, 2>>& change, const Picture& target,
                       const Positions& start, float max_move) {
  if (patches.shape(1) != patches.shape(2)) {
    throw nb::value_error("patches must be squares");
  }
  geometry::FoundPatches found;
  {
    const nb::gil_scoped_release release;
    found = geometry::find_patches({.pixels = span_of(patches),
                                    .side = static_cast<std::int64_t>(patches.shape(1)),
                                    .index = span_of(index),
                                    .middle = span_of(middle),
                                    .change = span_of(change)},
                                   grey_picture(target), span_of(start), max_move);
  }
  const std::size_t count = found.forward_backward_error.size();
  return nb::make_tuple(adopt<float>(std::move(found.xy), {count, 2}),
                        adopt(std::move(found.forward_backward_error)),
                        adopt(std::move(found.correlation)));
}

geometry::ObservedPoints observed_points(const Poses& cam_from_world, const Pairs& focal,
                                         const Indices& view, const Pairs& rays, const Points& xyz,
                                         const Indices& offsets, const Indices& observation) {
  return {.cam_from_world = span_of(cam_from_world),
          .focal = span_of(focal),
          .view = span_of(view),
          .rays = span_of(rays),
          .xyz = span_of(xyz),
          .offsets = span_of(offsets),
          .observation = span_of(observation)};
}

nb::object reprojection_errors(const Poses& cam_from_world, const Pairs& focal, const Indices& view,
                               const Pairs& rays, const Points& xyz, const Indices& offsets,
                               const Indices& observation) {
  std::vector<double> errors;
  {
    const nb::gil_scoped_release release;
    errors = geometry::reprojection_errors(
        observed_points(cam_from_world, focal, view, rays, xyz, offsets, observation));
  }
  return adopt(std::move(errors));
}

nb::object widest_angles(const Points& centres, const Points& xyz, const Indices& offsets,
                         const Indices& view) {
  std::vector<double> angles;
  {
    const nb::gil_scoped_release release;
    angles =
        geometry::widest_angles(span_of(centres), span_of(xyz), span_of(offsets), span_of(view));
  }
  return adopt(std::move(angles));
}

nb::object floater_observations(const Poses& cam_from_world, const Pairs& focal,
                                const Indices& view, const Pairs& rays, const Points& xyz,
                                const Indices& offsets, const Indices& observation,
                                double distance_share, double near_ratio, std::int64_t support,
                                double square_width, std::int64_t fewest_in_square) {
  std::vector<std::int64_t> counts;
  {
    const nb::gil_scoped_release release;
    counts = geometry::floater_observations(
        observed_points(cam_from_world, focal, view, rays, xyz, offsets, observation),
        {.distance_share = distance_share,
         .near_ratio = near_ratio,
         .support = support,
         .square_width = square_width,
         .fewest_in_square = fewest_in_square});
  }
  return adopt(std::move(counts));
}

nb::tuple points_in_view(const Pose& cam_from_world, const InputArray<double, nb::shape<2>>& low,
                         const InputArray<double, nb::shape<2>>& high, const Points& xyz) {
  geometry::PointsInView found;
  {
    const nb::gil_scoped_release release;
    found = geometry::points_in_view(span_of(cam_from_world),
                                     {.low_x = low.data()[0],
                                      .low_y = low.data()[1],
                                      .high_x = high.data()[0],
                                      .high_y = high.data()[1]},
                                     span_of(xyz));
  }
  const std::size_t count = found.index.size();
  return nb::make_tuple(adopt(std::move(found.index)),
                        adopt<double>(std::move(found.xyz), {count, 3}));
}

nb::tuple points_in_picture(const Pose& cam_from_world,
                            const InputArray<double, nb::shape<4>>& pinhole, double width,
                            double height, const Points& xyz) {
  const double* params = pinhole.data();
  geometry::PointsInPicture found;
  {
    const nb::gil_scoped_release release;
    found = geometry::points_in_picture(span_of(cam_from_world),
                                        {.focal_x = params[0],
                                         .focal_y = params[1],
                                         .centre_x = params[2],
                                         .centre_y = params[3],
                                         .width = width,
                                         .height = height},
                                        span_of(xyz));
  }
  const std::size_t count = found.index.size();
  return nb::make_tuple(adopt(std::move(found.index)),
                        adopt<double>(std::move(found.xy), {count, 2}),
                        adopt(std::move(found.depth)));
}

nb::object nearest_in_cells(const Pairs& xy, const Numbers& depth, int cell, std::int64_t columns,
                            std::int64_t rows) {
  std::vector<double> nearest;
  {
    const nb::gil_scoped_release release;
    nearest = geometry::nearest_in_cells(span_of(xy), span_of(depth), cell, columns, rows);
  }
  return adopt<double>(std::move(nearest),
                       {static_cast<std::size_t>(rows), static_cast<std::size_t>(columns)});
}

nb::object best_at_spacings(const Pairs& xy, const Numbers& depth, const Indices& rank,
                            std::int64_t width, std::int64_t height, const Indices& spacings,
                            double steps_per_octave, std::int64_t most_steps) {
  std::vector<std::int64_t> found;
  {
    const nb::gil_scoped_release release;
    found = geometry::best_at_spacings(span_of(xy), span_of(depth), span_of(rank), width, height,
                                       {.spacings = span_of(spacings),
                                        .steps_per_octave = steps_per_octave,
                                        .most_steps = most_steps});
  }
  return adopt(std::move(found));
}

}  // namespace

void bind_geometry(nb::module_& m) {
  m.def("triangulate", &triangulate, nb::kw_only(), "cam_from_world"_a, "focal"_a, "offsets"_a,
        "view"_a, "rays"_a, "sigma"_a, "first"_a, "last"_a, "min_observations"_a,
        "max_reprojection_error"_a, "min_angle"_a, "max_depth_error"_a.none(), "sigma_floor"_a,
        "error_to_sigma"_a,
        "Triangulate the tracks from `first` up to but excluding `last`: (xyz, error, count, "
        "observation, num_agreeing, num_tracks).");
  m.def("correlate_patches", &correlate_patches, "one"_a, "at_one"_a, "two"_a, "at_two"_a,
        nb::kw_only(), "min_deviation"_a,
        "Correlations [n, d] of the patches around positions [n, 2] in one grey picture with those "
        "around positions [n, d, 2] in another.");
  m.def("find_patches", &find_patches, "patches"_a, "index"_a, nb::kw_only(), "middle"_a,
        "change"_a, "target"_a, "start"_a, "max_move"_a,
        "Search a grey picture for patches [p, side, side] that another view deforms: (xy [n, 2], "
        "forward-backward error in pixels [n], inf if not found, correlation [n]).");
  m.def("reprojection_errors", &reprojection_errors, nb::kw_only(), "cam_from_world"_a, "focal"_a,
        "view"_a, "rays"_a, "xyz"_a, "offsets"_a, "observation"_a,
        "Reprojection error in pixels of each observation of points, inf behind the camera.");
  m.def("widest_angles", &widest_angles, nb::kw_only(), "centres"_a, "xyz"_a, "offsets"_a, "view"_a,
        "Largest triangulation angle of each point in radians; it may be slightly too small.");
  m.def("floater_observations", &floater_observations, nb::kw_only(), "cam_from_world"_a, "focal"_a,
        "view"_a, "rays"_a, "xyz"_a, "offsets"_a, "observation"_a, "distance_share"_a,
        "near_ratio"_a, "support"_a, "square_width"_a, "fewest_in_square"_a,
        "Number of observations of each point as a floater, in front of what is around it.");
  m.def("points_in_view", &points_in_view, "cam_from_world"_a, "low"_a, "high"_a, "xyz"_a,
        "The points in front of a camera with rays within bounds: (index, xyz in the camera).");
  m.def("points_in_picture", &points_in_picture, "cam_from_world"_a, "pinhole"_a, "width"_a,
        "height"_a, "xyz"_a,
        "The points that project into a pinhole camera's picture: (index, xy, depth).");
  m.def("nearest_in_cells", &nearest_in_cells, "xy"_a, "depth"_a, nb::kw_only(), "cell"_a,
        "columns"_a, "rows"_a,
        "Smallest of the depths [n] at pixels [n, 2] in each cell of a picture: [rows, columns].");
  m.def("best_at_spacings", &best_at_spacings, "xy"_a, "depth"_a, "rank"_a, nb::kw_only(),
        "width"_a, "height"_a, "spacings"_a, "steps_per_octave"_a, "most_steps"_a,
        "Index of the first spacing at which each point is the best of its cell and surface.");
}

}  // namespace colmap_av1
