// Block data per 4x4 luma unit, as readers get it.
#pragma once

#include <array>
#include <cstdint>
#include <memory>
#include <vector>

#include "av1/frame_state.h"

namespace colmap_av1::av1 {

// Leaves new elements of a vector as they are: every one of them is written after.
template <typename T>
struct Uninitialized : std::allocator<T> {
  template <typename U>
  struct rebind {
    using other = Uninitialized<U>;
  };
  template <typename U>
  void construct(U*) noexcept {}
};
template <typename T>
using UnitVector = std::vector<T, Uninitialized<T>>;

// Block data of a frame per unit, row after row.
struct Units {
  UnitVector<std::array<Mv, 2>> mv;
  UnitVector<std::array<std::int8_t, 2>> ref_frame;
  UnitVector<std::uint8_t> mi_size, y_mode, is_inter, skip, skip_mode, segment_id, motion_mode,
      compound_type, interintra, use_intrabc;
  UnitVector<std::int32_t> warp_index;  // into Event::local_warps, -1 without a valid warp
};

// Spreads the blocks of a frame's grid, which is complete, over its units.
void fill_units(const std::vector<BlockInfo*>& grid, Units& units);

}  // namespace colmap_av1::av1
