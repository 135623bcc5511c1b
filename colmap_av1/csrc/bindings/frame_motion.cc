#include "bindings/frame_motion.h"

#include <cstddef>
#include <cstdint>
#include <stdexcept>
#include <string>
#include <utility>

#include "bindings/arrays.h"
#include "tracks/displacement.h"

namespace nb = nanobind;

namespace colmap_av1 {
namespace {

constexpr std::size_t kMaxUnits = std::size_t{1} << 29;
constexpr std::size_t kMaxUnitsAlong = 65536;

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

nb::object displacement(nb::handle frame, int list_index) {
  if (list_index != 0 && list_index != 1) throw std::invalid_argument("list_index is 0 or 1");
  const HeldFrameMotion held(frame);
  const tracks::FrameMotion& motion = *held;
  std::vector<float> out(2 * static_cast<std::size_t>(motion.num_units()));
  {
    const nb::gil_scoped_release release;
    tracks::check_frame_motion(motion);
    tracks::displacement(motion, list_index, out.data());
  }
  const auto rows = static_cast<std::size_t>(motion.mi_rows);
  const auto cols = static_cast<std::size_t>(motion.mi_cols);
  return adopt<float>(std::move(out), {rows, cols, 2});
}

}  // namespace

HeldFrameMotion::HeldFrameMotion(nb::handle frame) {
  motion_.decode_index = read_int_attribute(frame, "decode_index");
  motion_.display_index = read_int_attribute(frame, "display_index");
  motion_.width = read_int_attribute(frame, "width");
  motion_.height = read_int_attribute(frame, "height");
  hold_header(frame.attr("header"));
  hold_references(frame);
  hold_units(frame);
}

template <typename T, typename Shape>
const T* HeldFrameMotion::hold(nb::handle values, const char* name, const char* expected) {
  InputArray<T, Shape> array;
  if (!nb::try_cast(values, array)) {
    throw nb::type_error((std::string(name) + " is not an array " + expected).c_str());
  }
  held_.emplace_back(array);
  return array.data();
}

void HeldFrameMotion::hold_header(nb::handle header) {
  motion_.show_frame = read_int(header["show_frame"], "show_frame") != 0;
  motion_.frame_width = read_int(header["frame_width"], "frame_width");
  motion_.force_integer_mv = read_int(header["force_integer_mv"], "force_integer_mv") != 0;
  motion_.gm_type = hold<std::int32_t, nb::shape<7>>(header["gm_type"], "gm_type", "int32 [7]");
  motion_.gm_params =
      hold<std::int32_t, nb::shape<7, 6>>(header["gm_params"], "gm_params", "int32 [7, 6]");
}

void HeldFrameMotion::hold_references(nb::handle frame) {
  const auto hold_indices = [&](const char* name) {
    return hold<std::int32_t, nb::shape<8>>(frame.attr(name), name, "int32 [8]");
  };
  motion_.ref_decode_index = hold_indices("ref_decode_index");
  motion_.ref_display_index = hold_indices("ref_display_index");
  motion_.slot_decode_index = hold_indices("slot_decode_index");
  motion_.ref_size =
      hold<std::int32_t, nb::shape<8, 2>>(frame.attr("ref_size"), "ref_size", "int32 [8, 2]");
}

void HeldFrameMotion::hold_units(nb::handle frame) {
  motion_.mv = hold<std::int16_t, nb::shape<-1, -1, 2, 2>>(frame.attr("mv"), "mv",
                                                           "int16 [mi_rows, mi_cols, 2, 2]");
  const std::size_t rows = held_.back().shape(0);
  const std::size_t cols = held_.back().shape(1);
  if (rows > kMaxUnitsAlong || cols > kMaxUnitsAlong || rows * cols > kMaxUnits) {
    throw std::invalid_argument("mv holds more units than an AV1 frame can have");
  }
  motion_.mi_rows = static_cast<int>(rows);
  motion_.mi_cols = static_cast<int>(cols);
  motion_.ref_frame = hold<std::int8_t, nb::shape<-1, -1, 2>>(frame.attr("ref_frame"), "ref_frame",
                                                              "int8 [mi_rows, mi_cols, 2]");
  check_units("ref_frame");
  const auto hold_bytes = [&](const char* name) {
    const auto* bytes =
        hold<std::uint8_t, nb::ndim<2>>(frame.attr(name), name, "uint8 [mi_rows, mi_cols]");
    check_units(name);
    return bytes;
  };
  motion_.mi_size = hold_bytes("mi_size");
  motion_.y_mode = hold_bytes("y_mode");
  motion_.is_inter = hold_bytes("is_inter");
  motion_.skip = hold_bytes("skip");
  motion_.motion_mode = hold_bytes("motion_mode");
  motion_.interintra = hold_bytes("interintra");
  motion_.use_intrabc = hold_bytes("use_intrabc");
  motion_.warp_index = hold<std::int32_t, nb::ndim<2>>(frame.attr("warp_index"), "warp_index",
                                                       "int32 [mi_rows, mi_cols]");
  check_units("warp_index");
  motion_.local_warp_params = hold<std::int32_t, nb::shape<-1, 6>>(
      frame.attr("local_warp_params"), "local_warp_params", "int32 [n, 6]");
  motion_.num_local_warps = static_cast<int>(held_.back().shape(0));
}

// Whether the array held last has the units of mv.
void HeldFrameMotion::check_units(const char* name) const {
  const auto& units = held_.back();
  if (units.shape(0) != static_cast<std::size_t>(motion_.mi_rows) ||
      units.shape(1) != static_cast<std::size_t>(motion_.mi_cols)) {
    throw std::invalid_argument(std::string(name) + " is not shaped [mi_rows, mi_cols] like mv");
  }
}

void bind_frame_motion(nb::module_& m) {
  using namespace nb::literals;
  m.def("displacement", &displacement, "frame"_a, "list_index"_a,
        "Displacement of unit centres, float32 [mi_rows, mi_cols, 2] (x, y) in pixels of the\n"
        "coded frame (width before super-resolution), NaN without a reference in the list.");
}

}  // namespace colmap_av1
