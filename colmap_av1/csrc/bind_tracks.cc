// Python's view of the tracks core: arrays in, arrays out, the GIL released between.

#include "bind_tracks.h"

#include <nanobind/ndarray.h>

#ifdef __GLIBC__
#include <malloc.h>
#endif

#include <cstddef>
#include <cstdint>
#include <initializer_list>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

#include "tracks/displacement.h"
#include "tracks/spread.h"
#include "tracks/track_builder.h"

namespace nb = nanobind;

namespace {

using colmap_av1::tracks::CodedFrame;
using colmap_av1::tracks::MotionField;
using colmap_av1::tracks::TrackArrays;
using colmap_av1::tracks::TrackBuilder;
using colmap_av1::tracks::TrackBuilderOptions;

template <typename T, typename Shape>
using Input = nb::ndarray<const T, Shape, nb::c_contig, nb::device::cpu>;
template <typename T>
using Units = Input<T, nb::ndim<2>>;
using UnitRefs = Input<int8_t, nb::shape<-1, -1, 2>>;
using UnitMvs = Input<int16_t, nb::shape<-1, -1, 2, 2>>;
using Warps = Input<int32_t, nb::shape<-1, 6>>;
using GmTypes = Input<int32_t, nb::shape<7>>;
using GmParams = Input<int32_t, nb::shape<7, 6>>;
using RefSizes = Input<int32_t, nb::shape<8, 2>>;
using RefIndices = Input<int32_t, nb::shape<8>>;

template <typename T>
nb::ndarray<nb::numpy, T> to_numpy(std::vector<T> values,
                                   std::initializer_list<std::size_t> shape) {
  auto* owned = new std::vector<T>(std::move(values));
  const nb::capsule owner(owned, [](void* p) noexcept { delete static_cast<std::vector<T>*>(p); });
  return nb::ndarray<nb::numpy, T>(owned->data(), shape, owner);
}

template <typename Array>
void check_units(const Array& array, const MotionField& field, const char* name) {
  if (array.shape(0) != static_cast<std::size_t>(field.mi_rows) ||
      array.shape(1) != static_cast<std::size_t>(field.mi_cols)) {
    throw std::invalid_argument(std::string(name) + " is not shaped [mi_rows, mi_cols] like mv");
  }
}

MotionField make_field(const UnitMvs& mv, const UnitRefs& ref_frame, const Units<uint8_t>& is_inter,
                       const Units<uint8_t>& use_intrabc, const Units<uint8_t>& motion_mode,
                       const Units<uint8_t>& interintra, const Units<uint8_t>& mi_size,
                       const Units<int32_t>& warp_index, const Warps& local_warp_params,
                       const GmTypes& gm_type, const GmParams& gm_params,
                       const Units<uint8_t>& y_mode, const RefSizes& ref_size, int width,
                       int height, bool force_integer_mv) {
  if (width <= 0 || height <= 0) throw std::invalid_argument("the picture has no size");
  if (mv.shape(0) > 65536 || mv.shape(1) > 65536 || mv.shape(0) * mv.shape(1) > (1U << 29)) {
    throw std::invalid_argument("mv holds more units than an AV1 frame can have");
  }
  MotionField field;
  field.mi_rows = static_cast<int>(mv.shape(0));
  field.mi_cols = static_cast<int>(mv.shape(1));
  check_units(ref_frame, field, "ref_frame");
  check_units(is_inter, field, "is_inter");
  check_units(use_intrabc, field, "use_intrabc");
  check_units(motion_mode, field, "motion_mode");
  check_units(interintra, field, "interintra");
  check_units(mi_size, field, "mi_size");
  check_units(warp_index, field, "warp_index");
  check_units(y_mode, field, "y_mode");
  field.width = width;
  field.height = height;
  field.mv = mv.data();
  field.ref_frame = ref_frame.data();
  field.is_inter = is_inter.data();
  field.use_intrabc = use_intrabc.data();
  field.motion_mode = motion_mode.data();
  field.interintra = interintra.data();
  field.mi_size = mi_size.data();
  field.warp_index = warp_index.data();
  field.local_warp_params = local_warp_params.data();
  field.num_local_warps = static_cast<int>(local_warp_params.shape(0));
  field.gm_type = gm_type.data();
  field.gm_params = gm_params.data();
  field.y_mode = y_mode.data();
  field.ref_size = ref_size.data();
  field.force_integer_mv = force_integer_mv;
  return field;
}

nb::ndarray<nb::numpy, float> displacement(
    int list_index, const UnitMvs& mv, const UnitRefs& ref_frame, const Units<uint8_t>& is_inter,
    const Units<uint8_t>& use_intrabc, const Units<uint8_t>& motion_mode,
    const Units<uint8_t>& interintra, const Units<uint8_t>& mi_size,
    const Units<int32_t>& warp_index, const Warps& local_warp_params, const GmTypes& gm_type,
    const GmParams& gm_params, const Units<uint8_t>& y_mode, const RefSizes& ref_size, int width,
    int height, bool force_integer_mv) {
  if (list_index != 0 && list_index != 1) throw std::invalid_argument("list_index is 0 or 1");
  const MotionField field =
      make_field(mv, ref_frame, is_inter, use_intrabc, motion_mode, interintra, mi_size,
                 warp_index, local_warp_params, gm_type, gm_params, y_mode, ref_size, width, height,
                 force_integer_mv);
  std::vector<float> out(2 * static_cast<std::size_t>(field.num_units()));
  {
    const nb::gil_scoped_release release;
    colmap_av1::tracks::check_motion_field(field);
    colmap_av1::tracks::displacement(field, list_index, out.data());
  }
  return to_numpy(std::move(out), {mv.shape(0), mv.shape(1), 2});
}

void add_frame(TrackBuilder& builder, int decode_index, int display_index, bool show_frame,
               int width, int height, int coded_width, const RefIndices& ref_decode_index,
               const RefIndices& ref_display_index, const RefIndices& slot_decode_index,
               const UnitMvs& mv, const UnitRefs& ref_frame, const Units<uint8_t>& is_inter,
               const Units<uint8_t>& use_intrabc, const Units<uint8_t>& motion_mode,
               const Units<uint8_t>& interintra, const Units<uint8_t>& mi_size,
               const Units<uint8_t>& skip, const Units<int32_t>& warp_index,
               const Warps& local_warp_params, const GmTypes& gm_type, const GmParams& gm_params,
               const Units<uint8_t>& y_mode, const RefSizes& ref_size, bool force_integer_mv) {
  if (width <= 0) throw std::invalid_argument("the picture has no size");
  CodedFrame frame;
  frame.field = make_field(mv, ref_frame, is_inter, use_intrabc, motion_mode, interintra, mi_size,
                           warp_index, local_warp_params, gm_type, gm_params, y_mode, ref_size,
                           coded_width, height, force_integer_mv);
  check_units(skip, frame.field, "skip");
  frame.skip = skip.data();
  frame.decode_index = decode_index;
  frame.display_index = display_index;
  frame.show_frame = show_frame;
  frame.width = width;
  frame.height = height;
  frame.ref_decode_index = ref_decode_index.data();
  frame.ref_display_index = ref_display_index.data();
  frame.slot_decode_index = slot_decode_index.data();
  const nb::gil_scoped_release release;
  builder.add(frame);
}

nb::tuple finish(TrackBuilder& builder) {
  TrackArrays tracks;
  {
    const nb::gil_scoped_release release;
    tracks = builder.finish();
#ifdef __GLIBC__
    // What was needed to build the tracks, as much as they are, would stay with the process.
    malloc_trim(0);
#endif
  }
  const std::size_t observations = tracks.frame.size();
  const std::size_t offsets = tracks.offsets.size();
  return nb::make_tuple(tracks.num_frames, tracks.width, tracks.height,
                        to_numpy(std::move(tracks.offsets), {offsets}),
                        to_numpy(std::move(tracks.frame), {observations}),
                        to_numpy(std::move(tracks.xy), {observations, 2}),
                        to_numpy(std::move(tracks.sigma), {observations}));
}

nb::ndarray<nb::numpy, uint8_t> select_spread(
    int num_frames, const Input<int64_t, nb::ndim<1>>& offsets,
    const Input<int32_t, nb::ndim<1>>& frame, const Input<float, nb::shape<-1, 2>>& xy,
    const Input<int64_t, nb::ndim<1>>& order, double spacing, int max_tracks_per_image,
    int min_length) {
  colmap_av1::tracks::TrackView view;
  view.num_frames = num_frames;
  view.offsets = {offsets.data(), offsets.shape(0)};
  view.frame = {frame.data(), frame.shape(0)};
  view.xy = {xy.data(), 2 * xy.shape(0)};
  std::vector<uint8_t> kept;
  {
    const nb::gil_scoped_release release;
    kept = colmap_av1::tracks::select_spread(view, {order.data(), order.shape(0)},
                                             {spacing, max_tracks_per_image, min_length});
  }
  return to_numpy(std::move(kept), {frame.shape(0)});
}

}  // namespace

void bind_tracks(nb::module_& m) {
  using namespace nb::literals;
  m.def("displacement", &displacement, "list_index"_a, "mv"_a, "ref_frame"_a, "is_inter"_a,
        "use_intrabc"_a, "motion_mode"_a, "interintra"_a, "mi_size"_a, "warp_index"_a,
        "local_warp_params"_a, "gm_type"_a, "gm_params"_a, "y_mode"_a, "ref_size"_a, "width"_a,
        "height"_a, "force_integer_mv"_a = false,
        "Displacement of unit centres, float32 [mi_rows, mi_cols, 2] (x, y) in pixels of the\n"
        "coded frame (width before super-resolution), NaN without a reference in the list.");

  nb::class_<TrackBuilder>(m, "TrackBuilder", "Chains the motion of coded frames into tracks.")
      .def(
          "__init__",
          [](TrackBuilder* self, int min_length, double cosine, bool cosine_relative_to_dominant,
             double cosine_scale, int max_interval, int max_block_area, int max_uncoded_block_area,
             double smoothness, double border, double interpolation, double bridge,
             int cells, int seeding) {
            TrackBuilderOptions options;
            options.min_length = min_length;
            options.cosine = cosine;
            options.cosine_relative_to_dominant = cosine_relative_to_dominant;
            options.cosine_scale = cosine_scale;
            options.max_interval = max_interval;
            options.max_block_area = max_block_area;
            options.max_uncoded_block_area = max_uncoded_block_area;
            options.smoothness = smoothness;
            options.border = border;
            options.bridge = bridge;
            options.interpolation = interpolation;
            options.cells = cells;
            options.seeding = seeding;
            new (self) TrackBuilder(options);
          },
          nb::kw_only(), "min_length"_a, "cosine"_a, "cosine_relative_to_dominant"_a,
          "cosine_scale"_a, "max_interval"_a, "max_block_area"_a, "max_uncoded_block_area"_a,
          "smoothness"_a,
          "border"_a, "interpolation"_a, "bridge"_a, "cells"_a = 1, "seeding"_a = 1)
      .def("add", &add_frame, nb::kw_only(), "decode_index"_a, "display_index"_a, "show_frame"_a,
           "width"_a,
           "height"_a, "coded_width"_a, "ref_decode_index"_a, "ref_display_index"_a,
           "slot_decode_index"_a, "mv"_a, "ref_frame"_a, "is_inter"_a, "use_intrabc"_a,
           "motion_mode"_a, "interintra"_a, "mi_size"_a, "skip"_a, "warp_index"_a,
           "local_warp_params"_a, "gm_type"_a, "gm_params"_a, "y_mode"_a, "ref_size"_a,
           "force_integer_mv"_a, "Adds one coded frame, in bitstream order.")
      .def("finish", &finish,
           "Ends all tracks: (num_frames, width, height, offsets, frame, xy, sigma).");

  m.def("select_spread", &select_spread, nb::kw_only(), "num_frames"_a, "offsets"_a, "frame"_a,
        "xy"_a, "order"_a, "spacing"_a, "max_tracks_per_image"_a, "min_length"_a,
        "Flags, uint8 [num_observations], of a spread choice of tracks, best first in `order`.");
}
