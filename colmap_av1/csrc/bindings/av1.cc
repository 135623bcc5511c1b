#include "bindings/av1.h"

#include <nanobind/stl/optional.h>
#include <nanobind/stl/pair.h>
#include <nanobind/stl/unique_ptr.h>

#include <cstddef>
#include <cstdint>
#include <memory>
#include <stdexcept>
#include <utility>
#include <vector>

#include "av1/error.h"
#include "av1/parser.h"
#include "bindings/arrays.h"
#include "bindings/buffer.h"

namespace nb = nanobind;
using namespace nb::literals;

namespace colmap_av1 {
namespace {

using av1::BlockInfo;
using av1::Event;
using av1::FrameHeader;
using av1::Parser;
using av1::ParserOptions;
using av1::RestartPoint;
using av1::SequenceHeader;

template <typename Array>
nb::object int32_array(const Array& values, std::size_t first = 0) {
  std::vector<std::int32_t> data(values.begin() + static_cast<std::ptrdiff_t>(first), values.end());
  return adopt(std::move(data));
}

nb::dict header_dict(const Event& event) {
  const FrameHeader& h = event.header;
  nb::dict d;
  d["temporal_unit"] = event.temporal_unit;
  d["obu_offset"] = event.obu_offset;
  d["temporal_id"] = h.temporal_id;
  d["spatial_id"] = h.spatial_id;
  d["show_existing_frame"] = static_cast<int>(h.show_existing_frame);
  d["frame_type"] = h.frame_type;
  d["show_frame"] = static_cast<int>(h.is_shown());
  d["order_hint"] = h.order_hint;
  d["refresh_frame_flags"] = h.refresh_frame_flags;
  if (h.show_existing_frame) {
    d["frame_to_show_map_idx"] = h.frame_to_show_map_idx;
    d["shown_decode_index"] = event.shown_decode_index;
    return d;
  }
#define COLMAP_AV1_FIELD(name) d[#name] = static_cast<int>(h.name);
  COLMAP_AV1_FIELD(showable_frame)
  COLMAP_AV1_FIELD(error_resilient_mode)
  COLMAP_AV1_FIELD(frame_width)
  COLMAP_AV1_FIELD(frame_height)
  COLMAP_AV1_FIELD(upscaled_width)
  COLMAP_AV1_FIELD(render_width)
  COLMAP_AV1_FIELD(render_height)
  COLMAP_AV1_FIELD(use_superres)
  COLMAP_AV1_FIELD(superres_denom)
  COLMAP_AV1_FIELD(mi_rows)
  COLMAP_AV1_FIELD(mi_cols)
  COLMAP_AV1_FIELD(base_q_idx)
  COLMAP_AV1_FIELD(primary_ref_frame)
  COLMAP_AV1_FIELD(allow_high_precision_mv)
  COLMAP_AV1_FIELD(force_integer_mv)
  COLMAP_AV1_FIELD(allow_intrabc)
  COLMAP_AV1_FIELD(reference_select)
  COLMAP_AV1_FIELD(skip_mode_present)
  COLMAP_AV1_FIELD(frame_refs_short_signaling)
  COLMAP_AV1_FIELD(disable_cdf_update)
  COLMAP_AV1_FIELD(disable_frame_end_update_cdf)
  COLMAP_AV1_FIELD(allow_screen_content_tools)
  COLMAP_AV1_FIELD(allow_warped_motion)
  COLMAP_AV1_FIELD(use_ref_frame_mvs)
  COLMAP_AV1_FIELD(is_motion_mode_switchable)
  COLMAP_AV1_FIELD(reduced_tx_set)
  COLMAP_AV1_FIELD(tx_mode)
  COLMAP_AV1_FIELD(interpolation_filter)
  COLMAP_AV1_FIELD(coded_lossless)
  COLMAP_AV1_FIELD(all_lossless)
  COLMAP_AV1_FIELD(using_qmatrix)
  COLMAP_AV1_FIELD(tile_cols)
  COLMAP_AV1_FIELD(tile_rows)
  COLMAP_AV1_FIELD(uniform_tile_spacing_flag)
  COLMAP_AV1_FIELD(context_update_tile_id)
  COLMAP_AV1_FIELD(tile_size_bytes)
  COLMAP_AV1_FIELD(segmentation_enabled)
  COLMAP_AV1_FIELD(segmentation_update_map)
  COLMAP_AV1_FIELD(segmentation_update_data)
  COLMAP_AV1_FIELD(segmentation_temporal_update)
  COLMAP_AV1_FIELD(seg_id_pre_skip)
  COLMAP_AV1_FIELD(last_active_seg_id)
  COLMAP_AV1_FIELD(delta_q_present)
  COLMAP_AV1_FIELD(delta_q_res)
  COLMAP_AV1_FIELD(delta_lf_present)
  COLMAP_AV1_FIELD(delta_lf_res)
  COLMAP_AV1_FIELD(delta_lf_multi)
  COLMAP_AV1_FIELD(cdef_bits)
#undef COLMAP_AV1_FIELD
  d["loop_filter_level0"] = h.loop_filter_level[0];
  d["loop_filter_level1"] = h.loop_filter_level[1];
  d["num_tile_groups"] = event.num_tile_groups;
  d["skip_mode_frame"] = int32_array(h.skip_mode_frame);
  d["ref_frame_idx"] = int32_array(h.ref_frame_idx);
  d["ref_order_hint"] = int32_array(h.order_hints, 1);
  d["gm_type"] = int32_array(h.gm_type, 1);
  std::vector<std::int32_t> gm;
  for (int ref = av1::LAST_FRAME; ref <= av1::ALTREF_FRAME; ++ref) {
    gm.insert(gm.end(), h.gm_params[ref].begin(), h.gm_params[ref].end());
  }
  d["gm_params"] = adopt<std::int32_t>(std::move(gm), {7, 6});
  return d;
}

nb::dict sequence_dict(const SequenceHeader& s, int operating_point_idc) {
  nb::dict d;
#define COLMAP_AV1_FIELD(name) d[#name] = static_cast<int>(s.name);
  COLMAP_AV1_FIELD(seq_profile)
  COLMAP_AV1_FIELD(still_picture)
  COLMAP_AV1_FIELD(reduced_still_picture_header)
  COLMAP_AV1_FIELD(bit_depth)
  COLMAP_AV1_FIELD(mono_chrome)
  COLMAP_AV1_FIELD(subsampling_x)
  COLMAP_AV1_FIELD(subsampling_y)
  COLMAP_AV1_FIELD(use_128x128_superblock)
  COLMAP_AV1_FIELD(operating_points_cnt_minus_1)
  COLMAP_AV1_FIELD(film_grain_params_present)
  COLMAP_AV1_FIELD(frame_id_numbers_present_flag)
  COLMAP_AV1_FIELD(enable_filter_intra)
  COLMAP_AV1_FIELD(enable_intra_edge_filter)
  COLMAP_AV1_FIELD(enable_interintra_compound)
  COLMAP_AV1_FIELD(enable_masked_compound)
  COLMAP_AV1_FIELD(enable_dual_filter)
  COLMAP_AV1_FIELD(enable_order_hint)
  COLMAP_AV1_FIELD(enable_jnt_comp)
  COLMAP_AV1_FIELD(enable_ref_frame_mvs)
  COLMAP_AV1_FIELD(enable_warped_motion)
  COLMAP_AV1_FIELD(enable_superres)
  COLMAP_AV1_FIELD(enable_cdef)
  COLMAP_AV1_FIELD(enable_restoration)
  COLMAP_AV1_FIELD(seq_force_integer_mv)
  COLMAP_AV1_FIELD(seq_force_screen_content_tools)
#undef COLMAP_AV1_FIELD
  d["operating_point_idc0"] = s.operating_point_idc[0];
  d["operating_point_idc"] = operating_point_idc;
  d["max_frame_width"] = s.max_frame_width_minus_1 + 1;
  d["max_frame_height"] = s.max_frame_height_minus_1 + 1;
  return d;
}

// The blocks of a decoded frame as bytes, the index of each unit's block, and the local warps. The
// first two are moved out of the event, so this can be called once.
nb::tuple take_blocks(Event& event) {
  if (event.block_index.empty()) throw std::logic_error("the event has no blocks");
  const auto rows = static_cast<std::size_t>(event.header.mi_rows);
  const auto cols = static_cast<std::size_t>(event.header.mi_cols);
  std::vector<std::int32_t> params;
  params.reserve(event.local_warps.size() * 6);
  for (const auto& warp : event.local_warps) {
    params.insert(params.end(), warp.params.begin(), warp.params.end());
  }
  const std::size_t num_bytes = event.blocks.size() * sizeof(BlockInfo);
  return nb::make_tuple(
      adopt<std::uint8_t>(std::move(event.blocks), {num_bytes}),
      adopt<std::int32_t>(std::move(event.block_index), {rows, cols}),
      adopt<std::int32_t>(std::move(params), {event.local_warps.size(), std::size_t{6}}));
}

}  // namespace

void bind_av1(nb::module_& m) {
  nb::exception<av1::BitstreamError>(m, "BitstreamError");
  nb::exception<av1::LimitError>(m, "LimitError");

  nb::class_<Event>(m, "Event")
      .def_ro("decode_index", &Event::decode_index)
      .def_ro("shown_decode_index", &Event::shown_decode_index)
      .def_ro("temporal_unit", &Event::temporal_unit)
      .def_ro("num_wrong_trailing_bits", &Event::num_wrong_trailing_bits)
      .def_prop_ro("num_units", [](const Event& e) { return e.header.mi_rows * e.header.mi_cols; })
      .def_prop_ro("is_repeated", [](const Event& e) { return e.header.show_existing_frame; })
      .def_prop_ro("is_shown", [](const Event& e) { return e.header.is_shown(); })
      .def_prop_ro("is_shown_key_frame",
                   [](const Event& e) { return e.header.is_shown_key_frame(); })
      .def("header", &header_dict)
      .def("take_blocks", &take_blocks)
      .def("tile_sizes", [](const Event& e) { return int32_array(e.tile_sizes); })
      .def("ref_decode_index", [](const Event& e) { return int32_array(e.ref_decode_index); })
      .def("ref_size",
           [](const Event& e) {
             std::vector<std::int32_t> sizes;
             for (const auto& size : e.ref_size)
               sizes.insert(sizes.end(), size.begin(), size.end());
             return adopt<std::int32_t>(std::move(sizes), {8, 2});
           })
      .def("slot_decode_index", [](const Event& e) { return int32_array(e.slot_decode_index); });

  nb::class_<RestartPoint>(m, "RestartPoint");

  nb::class_<Parser>(m, "Parser")
      .def(
          "__init__",
          [](Parser* self, int operating_point, bool headers_only, int num_threads, bool strict,
             std::int64_t max_frame_size) {
            new (self) Parser(
                ParserOptions{operating_point, headers_only, num_threads, strict, max_frame_size});
          },
          "operating_point"_a = 0, "headers_only"_a = false, "num_threads"_a = 1,
          "strict"_a = false, "max_frame_size"_a = std::int64_t{1} << 28)
      .def(
          "parse",
          [](Parser& self, nb::object data, std::size_t position) {
            const Buffer bytes(data);
            if (position > bytes.get().size()) throw std::out_of_range("position");
            std::unique_ptr<Event> event;
            {
              nb::gil_scoped_release release;
              event = self.parse(bytes.get(), position);
            }
            return std::make_pair(std::move(event), position);
          },
          "data"_a, "position"_a = 0)
      .def("finish", &Parser::finish)
      .def("restart_point", &Parser::restart_point)
      .def("restart", &Parser::restart, "point"_a)
      .def("sequence_header", [](const Parser& self) -> nb::object {
        if (self.sequence_header() == nullptr) return nb::none();
        return sequence_dict(*self.sequence_header(), self.operating_point_idc());
      });
}

}  // namespace colmap_av1
