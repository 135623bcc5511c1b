// Python's view of the model core: arrays in, arrays out, the GIL released between.

#include "bindings/model.h"

#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>

#include <cstddef>
#include <cstdint>
#include <optional>
#include <utility>
#include <vector>

#include "bindings/arrays.h"
#include "model/patches.h"
#include "model/triangulate.h"

namespace nb = nanobind;
using namespace nb::literals;

namespace colmap_av1 {
namespace {

nb::tuple triangulate(const InputArray<double, nb::shape<-1, 3, 4>>& cam_from_world,
                      const InputArray<double, nb::shape<-1, 2>>& focal,
                      const InputArray<std::int64_t, nb::ndim<1>>& offsets,
                      const InputArray<std::int64_t, nb::ndim<1>>& view,
                      const InputArray<double, nb::shape<-1, 2>>& rays,
                      const InputArray<float, nb::ndim<1>>& sigma, std::int64_t first,
                      std::int64_t last, int min_observations, double max_reprojection_error,
                      double min_angle, std::optional<double> max_depth_error, double sigma_floor,
                      double error_to_sigma) {
  const model::PosedTracks tracks{
      .cam_from_world = {cam_from_world.data(), 12 * cam_from_world.shape(0)},
      .focal = {focal.data(), 2 * focal.shape(0)},
      .offsets = {offsets.data(), offsets.shape(0)},
      .view = {view.data(), view.shape(0)},
      .rays = {rays.data(), 2 * rays.shape(0)},
      .sigma = {sigma.data(), sigma.shape(0)}};
  model::PointArrays points;
  {
    const nb::gil_scoped_release release;
    points = model::triangulate(tracks, first, last,
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

using Picture = InputArray<std::uint8_t, nb::ndim<2>>;

model::GreyPicture grey_picture(const Picture& pixels) {
  return {.pixels = {pixels.data(), pixels.size()},
          .width = static_cast<std::int64_t>(pixels.shape(1)),
          .height = static_cast<std::int64_t>(pixels.shape(0))};
}

nb::object correlate_patches(const Picture& one, const InputArray<float, nb::shape<-1, 2>>& at_one,
                             const Picture& two,
                             const InputArray<float, nb::shape<-1, -1, 2>>& at_two,
                             float min_deviation) {
  if (at_one.shape(0) != at_two.shape(0)) {
    throw nb::value_error("at_one and at_two are of different lengths");
  }
  std::vector<float> found;
  {
    const nb::gil_scoped_release release;
    found =
        model::correlate_patches(grey_picture(one), {at_one.data(), at_one.size()},
                                 grey_picture(two), {at_two.data(), at_two.size()}, min_deviation);
  }
  return adopt<float>(std::move(found), {at_two.shape(0), at_two.shape(1)});
}

}  // namespace

void bind_model(nb::module_& m) {
  m.def("triangulate", &triangulate, nb::kw_only(), "cam_from_world"_a, "focal"_a, "offsets"_a,
        "view"_a, "rays"_a, "sigma"_a, "first"_a, "last"_a, "min_observations"_a,
        "max_reprojection_error"_a, "min_angle"_a, "max_depth_error"_a.none(), "sigma_floor"_a,
        "error_to_sigma"_a,
        "Points of the tracks from `first` to before `last`: (xyz, error, count, observation, "
        "num_agreeing, num_tracks).");
  m.def("correlate_patches", &correlate_patches, "one"_a, "at_one"_a, "two"_a, "at_two"_a,
        nb::kw_only(), "min_deviation"_a,
        "Correlations [n, d] of the patches around positions [n, 2] in one grey picture with those "
        "around positions [n, d, 2] in another.");
}

}  // namespace colmap_av1
