#include "bindings/frame_motion.h"

#include <algorithm>
#include <array>
#include <cstddef>
#include <cstdint>
#include <stdexcept>
#include <string>
#include <type_traits>
#include <vector>

#include "tracks/displacement.h"

namespace nb = nanobind;
using namespace nb::literals;

namespace colmap_av1 {
namespace {

// AV1 frames have at most 65536 pixels in each direction, units have 4.
constexpr std::size_t kMaxUnitsAlong = 65536 / 4;

int read_int(nb::handle value, const char* name) {
  int number = 0;
  if (!nb::try_cast(value, number)) {
    throw nb::type_error((std::string(name) + " is not an integer of 32 bits").c_str());
  }
  return number;
}

int read_int_attribute(nb::handle frame, const char* name) {
  return read_int(frame.attr(name), name);
}

template <typename Array>
Array read_array(nb::handle values, const char* name, const char* expected) {
  Array array;
  if (!nb::try_cast(values, array)) {
    throw nb::type_error((std::string(name) + " is not an array " + expected).c_str());
  }
  return array;
}

std::array<std::int32_t, 8> read_indices(nb::handle frame, const char* name) {
  const auto array =
      read_array<InputArray<std::int32_t, nb::shape<8>>>(frame.attr(name), name, "int32 [8]");
  std::array<std::int32_t, 8> indices{};
  std::copy_n(array.data(), indices.size(), indices.begin());
  return indices;
}

// NumPy's name for the type of a field
template <typename T>
std::string format_of(const T&) {
  static_assert(std::is_integral_v<T>);
  return (std::is_signed_v<T> ? "i" : "u") + std::to_string(sizeof(T));
}
template <std::size_t kSize>
std::string format_of(const std::array<av1::Mv, kSize>&) {
  return "(" + std::to_string(kSize) + ",2)i2";
}
template <typename T, std::size_t kSize>
std::string format_of(const std::array<T, kSize>& values) {
  return "(" + std::to_string(kSize) + ",)" + format_of(values[0]);
}

// BlockInfo as a NumPy record type
nb::object block_dtype() {
  const av1::BlockInfo block;
  nb::list names;
  nb::list formats;
  nb::list offsets;
  const auto field = [&](const char* name, std::size_t offset, const std::string& format) {
    names.append(name);
    offsets.append(offset);
    formats.append(format.c_str());
  };
#define COLMAP_AV1_FIELD(name) field(#name, offsetof(av1::BlockInfo, name), format_of(block.name));
  COLMAP_AV1_FIELD(mv)
  COLMAP_AV1_FIELD(mi_size)
  COLMAP_AV1_FIELD(y_mode)
  COLMAP_AV1_FIELD(is_inter)
  COLMAP_AV1_FIELD(skip)
  COLMAP_AV1_FIELD(skip_mode)
  COLMAP_AV1_FIELD(segment_id)
  COLMAP_AV1_FIELD(motion_mode)
  COLMAP_AV1_FIELD(compound_type)
  COLMAP_AV1_FIELD(interintra)
  COLMAP_AV1_FIELD(use_intrabc)
  COLMAP_AV1_FIELD(ref_frame)
  COLMAP_AV1_FIELD(local_warp)
  COLMAP_AV1_FIELD(warp_index)
  COLMAP_AV1_FIELD(mi_row)
  COLMAP_AV1_FIELD(mi_col)
  COLMAP_AV1_FIELD(uv_mode)
  COLMAP_AV1_FIELD(partition)
  COLMAP_AV1_FIELD(use_filter_intra)
  COLMAP_AV1_FIELD(has_chroma)
  COLMAP_AV1_FIELD(interp_filter)
  COLMAP_AV1_FIELD(palette_size)
  COLMAP_AV1_FIELD(comp_group_idx)
  COLMAP_AV1_FIELD(compound_idx)
  COLMAP_AV1_FIELD(tx_size)
  COLMAP_AV1_FIELD(angle_delta_y)
  COLMAP_AV1_FIELD(angle_delta_uv)
  COLMAP_AV1_FIELD(filter_intra_mode)
  COLMAP_AV1_FIELD(cfl_alpha_idx)
  COLMAP_AV1_FIELD(cfl_alpha_signs)
  COLMAP_AV1_FIELD(interintra_mode)
  COLMAP_AV1_FIELD(wedge_interintra)
  COLMAP_AV1_FIELD(wedge_index)
  COLMAP_AV1_FIELD(wedge_sign)
  COLMAP_AV1_FIELD(mask_type)
  COLMAP_AV1_FIELD(num_samples)
  COLMAP_AV1_FIELD(current_q_index)
  COLMAP_AV1_FIELD(delta_lf)
#undef COLMAP_AV1_FIELD
  nb::dict layout;
  layout["names"] = names;
  layout["formats"] = formats;
  layout["offsets"] = offsets;
  layout["itemsize"] = sizeof(av1::BlockInfo);
  return nb::module_::import_("numpy").attr("dtype")(layout);
}

nb::object displacement(nb::handle frame, int list_index) {
  if (list_index != 0 && list_index != 1) throw std::invalid_argument("list_index is 0 or 1");
  const HeldFrameMotion held(frame);
  const tracks::FrameMotion& motion = *held;
  std::vector<float> found;
  {
    const nb::gil_scoped_release release;
    tracks::check_frame_motion(motion);
    found = tracks::displacement(motion, list_index);
  }
  const auto rows = static_cast<std::size_t>(motion.mi_rows);
  const auto cols = static_cast<std::size_t>(motion.mi_cols);
  return adopt<float>(std::move(found), {rows, cols, 2});
}

}  // namespace

HeldFrameMotion::HeldFrameMotion(nb::handle frame) {
  motion_.decode_index = read_int_attribute(frame, "decode_index");
  motion_.display_index = read_int_attribute(frame, "display_index");
  motion_.width = read_int_attribute(frame, "width");
  motion_.height = read_int_attribute(frame, "height");
  motion_.ref_decode_index = read_indices(frame, "ref_decode_index");
  motion_.ref_display_index = read_indices(frame, "ref_display_index");
  motion_.slot_decode_index = read_indices(frame, "slot_decode_index");
  const auto ref_size = read_array<InputArray<std::int32_t, nb::shape<8, 2>>>(
      frame.attr("ref_size"), "ref_size", "int32 [8, 2]");
  for (std::size_t ref = 0; ref < motion_.ref_size.size(); ++ref) {
    motion_.ref_size[ref] = {ref_size(ref, 0), ref_size(ref, 1)};
  }
  const nb::object header = frame.attr("header");
  motion_.show_frame = read_int(header["show_frame"], "show_frame") != 0;
  motion_.frame_width = read_int(header["frame_width"], "frame_width");
  motion_.force_integer_mv = read_int(header["force_integer_mv"], "force_integer_mv") != 0;
  const auto gm_type =
      read_array<InputArray<std::int32_t, nb::shape<7>>>(header["gm_type"], "gm_type", "int32 [7]");
  const auto gm_params = read_array<InputArray<std::int32_t, nb::shape<7, 6>>>(
      header["gm_params"], "gm_params", "int32 [7, 6]");
  for (std::size_t ref = 1; ref < motion_.gm_type.size(); ++ref) {
    motion_.gm_type[ref] = gm_type(ref - 1);
    for (std::size_t i = 0; i < 6; ++i) motion_.gm_params[ref][i] = gm_params(ref - 1, i);
  }
  hold_blocks(frame);
}

void HeldFrameMotion::hold_blocks(nb::handle frame) {
  const nb::object blocks = frame.attr("blocks");
  if (!nb::hasattr(blocks, "dtype") || !blocks.attr("dtype").equal(block_dtype())) {
    throw nb::type_error("blocks is not an array of BLOCK");
  }
  blocks_.emplace(nb::module_::import_("numpy").attr("ascontiguousarray")(blocks));
  const auto bytes = blocks_->get();
  if (reinterpret_cast<std::uintptr_t>(bytes.data()) % alignof(av1::BlockInfo) != 0) {
    throw std::invalid_argument("blocks do not start at a multiple of 4 bytes in memory");
  }
  motion_.blocks = {reinterpret_cast<const av1::BlockInfo*>(bytes.data()),
                    bytes.size() / sizeof(av1::BlockInfo)};
  block_index_ = read_array<decltype(block_index_)>(frame.attr("block_index"), "block_index",
                                                    "int32 [mi_rows, mi_cols]");
  const std::size_t rows = block_index_.shape(0);
  const std::size_t cols = block_index_.shape(1);
  if (rows > kMaxUnitsAlong || cols > kMaxUnitsAlong) {
    throw std::invalid_argument("block_index holds more units than an AV1 frame can have");
  }
  motion_.mi_rows = static_cast<int>(rows);
  motion_.mi_cols = static_cast<int>(cols);
  motion_.block_index = {block_index_.data(), rows * cols};
  local_warp_params_ = read_array<decltype(local_warp_params_)>(
      frame.attr("local_warp_params"), "local_warp_params", "int32 [n, 6]");
  motion_.local_warp_params = {reinterpret_cast<const av1::WarpParams*>(local_warp_params_.data()),
                               local_warp_params_.shape(0)};
}

void bind_frame_motion(nb::module_& m) {
  m.def("block_dtype", &block_dtype, "The record of a block.");
  m.def("displacement", &displacement, "frame"_a, "list_index"_a,
        "Displacement of unit centres, float32 [mi_rows, mi_cols, 2] (x, y) in pixels of the\n"
        "coded frame (width before super-resolution), NaN without a reference in the list.");
}

}  // namespace colmap_av1
