// Motion field estimation (specification section 7.9) and storage (7.19).
#pragma once

#include <algorithm>
#include <array>
#include <cstdint>
#include <vector>

#include "av1/frame_state.h"
#include "av1/spec_tables.h"

namespace colmap_av1::av1 {

// 7.9.3 Get MV projection process, in two steps: the factor for a pair of distances, and its
// product with a vector.
inline int projection_factor(int numerator, int denominator) {
  const int clipped = std::clamp(numerator, -MAX_FRAME_DISTANCE, MAX_FRAME_DISTANCE);
  return clipped * kDivMult[std::min(MAX_FRAME_DISTANCE, denominator)];
}
inline Mv project_mv(Mv mv, int factor) {
  const auto scale = [factor](int v) {
    const int product = v * factor;
    const int sign = product >> 31;
    const int scaled = ((((product ^ sign) - sign) + (1 << 13)) >> 14 ^ sign) - sign;
    return static_cast<std::int16_t>(std::clamp(scaled, -(1 << 14) + 1, (1 << 14) - 1));
  };
  return {scale(mv.row), scale(mv.col)};
}

// 7.9 Motion field estimation process: [mi_rows / 2][mi_cols / 2]. `references` by RefFrame; entry
// 0 is not used.
std::vector<MotionFieldEntry> estimate_motion_field(
    const SequenceHeader& seq, const FrameHeader& header,
    const std::array<const FrameState*, TOTAL_REFS_PER_FRAME>& references);

// 7.19 Motion field motion vector storage process
std::vector<SavedMotion> save_motion(const SequenceHeader& seq, const FrameContext& frame);

}  // namespace colmap_av1::av1
