// Python bindings of the tracks core: frames and arrays in, arrays out; the GIL is released.

#include "bindings/tracks.h"

#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/vector.h>

#include <cstddef>
#include <cstdint>
#include <utility>
#include <vector>

#include "bindings/arrays.h"
#include "bindings/frame_motion.h"
#include "tracks/spread.h"
#include "tracks/track_builder.h"

namespace nb = nanobind;
using namespace nb::literals;

namespace colmap_av1 {
namespace {

using tracks::TrackArrays;
using tracks::TrackBuilder;
using tracks::TrackBuilderOptions;

void add_frame(TrackBuilder& builder, nb::handle frame) {
  const HeldFrameMotion motion(frame);
  const nb::gil_scoped_release release;
  builder.add(*motion);
}

nb::tuple adopt_tracks(TrackArrays&& arrays) {
  const std::size_t observations = arrays.frame.size();
  return nb::make_tuple(arrays.num_frames, arrays.width, arrays.height,
                        adopt(std::move(arrays.offsets)), adopt(std::move(arrays.frame)),
                        adopt<float>(std::move(arrays.xy), {observations, 2}),
                        adopt(std::move(arrays.sigma)));
}

nb::tuple finish(TrackBuilder& builder) {
  TrackBuilder::Result result;
  {
    const nb::gil_scoped_release release;
    result = builder.finish();
  }
  return nb::make_tuple(adopt_tracks(std::move(result.tracks)),
                        adopt_tracks(std::move(result.ends)));
}

nb::object select_spread(int num_frames, const InputArray<std::int64_t, nb::ndim<1>>& offsets,
                         const InputArray<std::int32_t, nb::ndim<1>>& frame,
                         const InputArray<float, nb::shape<-1, 2>>& xy,
                         const InputArray<std::int64_t, nb::ndim<1>>& order, double spacing,
                         int max_tracks_per_image, int min_length) {
  tracks::TrackView view;
  view.num_frames = num_frames;
  view.offsets = {offsets.data(), offsets.shape(0)};
  view.frame = {frame.data(), frame.shape(0)};
  view.xy = {xy.data(), 2 * xy.shape(0)};
  std::vector<std::uint8_t> kept;
  {
    const nb::gil_scoped_release release;
    kept = tracks::select_spread(view, {order.data(), order.shape(0)},
                                 {spacing, max_tracks_per_image, min_length});
  }
  return adopt(std::move(kept));
}

void bind_options(nb::module_& m) {
  nb::class_<TrackBuilderOptions>(m, "TrackBuilderOptions", "A limit that is None is off.")
      .def(nb::init<>())
      .def_rw("min_length", &TrackBuilderOptions::min_length)
      .def_rw("cosine", &TrackBuilderOptions::cosine)
      .def_rw("cosine_relative_to_dominant", &TrackBuilderOptions::cosine_relative_to_dominant)
      .def_rw("cosine_scale", &TrackBuilderOptions::cosine_scale)
      .def_rw("max_interval", &TrackBuilderOptions::max_interval)
      .def_rw("max_block_area", &TrackBuilderOptions::max_block_area)
      .def_rw("max_uncoded_block_area", &TrackBuilderOptions::max_uncoded_block_area)
      .def_rw("smoothness", &TrackBuilderOptions::smoothness)
      .def_rw("border", &TrackBuilderOptions::border)
      .def_rw("interpolation", &TrackBuilderOptions::interpolation)
      .def_rw("bridge", &TrackBuilderOptions::bridge)
      .def_rw("cells", &TrackBuilderOptions::cells)
      .def_rw("seeding", &TrackBuilderOptions::seeding)
      .def_rw("stored_frames", &TrackBuilderOptions::stored_frames)
      .def_rw("tracks_per_sample", &TrackBuilderOptions::tracks_per_sample);
}

}  // namespace

void bind_tracks(nb::module_& m) {
  bind_options(m);
  nb::class_<TrackBuilder>(m, "TrackBuilder", "Chains the motion of coded frames into tracks.")
      .def(nb::init<const TrackBuilderOptions&>(), "options"_a)
      .def("add", &add_frame, "frame"_a, "Adds one coded frame, in bitstream order.")
      .def("finish", &finish,
           "Ends all tracks: the kept tracks, and the ends of some tracks, each as (num_frames, "
           "width, height, offsets, frame, xy, sigma).");

  m.def("select_spread", &select_spread, nb::kw_only(), "num_frames"_a, "offsets"_a, "frame"_a,
        "xy"_a, "order"_a, "spacing"_a, "max_tracks_per_image"_a, "min_length"_a,
        "Select spread tracks, the best first in `order`: flags, uint8 [num_observations].");
}

}  // namespace colmap_av1
