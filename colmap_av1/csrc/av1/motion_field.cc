#include "av1/motion_field.h"

#include <algorithm>
#include <cstdlib>

namespace colmap_av1::av1 {
namespace {

// 7.9.4 Get block position process, for one coordinate: the number of 8x8 areas that a projected
// vector moves
int position_offset(int delta, int dst_sign) {
  constexpr int kShift = 3 + 1 + MI_SIZE_LOG2;
  return dst_sign * (delta >= 0 ? delta >> kShift : -((-delta) >> kShift));
}

// Whether a position is in the frame, and not too far from where it was projected from
bool is_position_valid(int position, int v8, int max8, int max_off8) {
  const int base8 = v8 & ~7;
  return position >= std::max(0, base8 - max_off8) &&
         position < std::min(max8, base8 + 8 + max_off8);
}

// 7.9.2 Projection process
bool project(const SequenceHeader& seq, const FrameHeader& header, const FrameState* source,
             int src, int dst_sign, std::vector<MotionFieldEntry>& motion_field) {
  if (source == nullptr || source->header.mi_rows != header.mi_rows ||
      source->header.mi_cols != header.mi_cols || source->header.frame_is_intra) {
    return false;
  }
  const int h8 = header.mi_rows >> 1;
  const int w8 = header.mi_cols >> 1;
  const int src_hint = header.order_hints[src];
  const int ref_to_cur = seq.relative_dist(src_hint, header.order_hint);
  if (std::abs(ref_to_cur) > MAX_FRAME_DISTANCE) return true;
  std::array<int, TOTAL_REFS_PER_FRAME> ref_offsets{};
  std::array<int, TOTAL_REFS_PER_FRAME> factors{};
  for (int ref = LAST_FRAME; ref <= ALTREF_FRAME; ++ref) {
    const int offset = seq.relative_dist(src_hint, source->header.order_hints[ref]);
    ref_offsets[ref] = offset > 0 && offset <= MAX_FRAME_DISTANCE ? offset : 0;
    if (ref_offsets[ref] > 0) {
      factors[ref] = projection_factor(ref_to_cur * dst_sign, ref_offsets[ref]);
    }
  }
  const SavedMotion* saved = source->saved_motion.data();
  // Neighbours often have the same motion, so the last projection is reused.
  SavedMotion last;
  int offset_y8 = 0;
  int offset_x8 = 0;
  for (int y8 = 0; y8 < h8; ++y8) {
    for (int x8 = 0; x8 < w8; ++x8, ++saved) {
      if (saved->ref_frame <= INTRA_FRAME) continue;
      const int ref_offset = ref_offsets[saved->ref_frame];
      if (ref_offset == 0) continue;
      if (*saved != last) {
        last = *saved;
        const Mv projected = project_mv(last.mv, factors[last.ref_frame]);
        offset_y8 = position_offset(projected.row, dst_sign);
        offset_x8 = position_offset(projected.col, dst_sign);
      }
      const int pos_y8 = y8 + offset_y8;
      const int pos_x8 = x8 + offset_x8;
      if (!is_position_valid(pos_y8, y8, h8, MAX_OFFSET_HEIGHT) ||
          !is_position_valid(pos_x8, x8, w8, MAX_OFFSET_WIDTH)) {
        continue;
      }
      motion_field[static_cast<std::size_t>(pos_y8) * static_cast<std::size_t>(w8) +
                   static_cast<std::size_t>(pos_x8)] = {saved->mv,
                                                        static_cast<std::int8_t>(ref_offset)};
    }
  }
  return true;
}

}  // namespace

std::vector<MotionFieldEntry> estimate_motion_field(
    const SequenceHeader& seq, const FrameHeader& header,
    const std::array<const FrameState*, TOTAL_REFS_PER_FRAME>& references) {
  std::vector<MotionFieldEntry> motion_field(static_cast<std::size_t>(header.mi_rows >> 1) *
                                             static_cast<std::size_t>(header.mi_cols >> 1));
  const auto project_from = [&](int src, int dst_sign) {
    return project(seq, header, references[src], src, dst_sign, motion_field);
  };
  const FrameState* last = references[LAST_FRAME];
  if (last != nullptr &&
      last->header.order_hints[ALTREF_FRAME] != header.order_hints[GOLDEN_FRAME]) {
    project_from(LAST_FRAME, -1);
  }
  int ref_stamp = MFMV_STACK_SIZE - 2;
  const auto is_backward = [&](int ref) {
    return seq.relative_dist(header.order_hints[ref], header.order_hint) > 0;
  };
  if (is_backward(BWDREF_FRAME) && project_from(BWDREF_FRAME, 1)) --ref_stamp;
  if (is_backward(ALTREF2_FRAME) && project_from(ALTREF2_FRAME, 1)) --ref_stamp;
  if (is_backward(ALTREF_FRAME) && ref_stamp >= 0 && project_from(ALTREF_FRAME, 1)) --ref_stamp;
  if (ref_stamp >= 0) project_from(LAST2_FRAME, -1);
  return motion_field;
}

std::vector<SavedMotion> save_motion(const SequenceHeader& seq, const FrameContext& frame) {
  const FrameHeader& header = *frame.header;
  const int h8 = header.mi_rows >> 1;
  const int w8 = header.mi_cols >> 1;
  std::vector<SavedMotion> saved_motion(static_cast<std::size_t>(h8) *
                                        static_cast<std::size_t>(w8));
  std::array<bool, TOTAL_REFS_PER_FRAME> is_forward{};
  for (int ref = LAST_FRAME; ref <= ALTREF_FRAME; ++ref) {
    is_forward[ref] = seq.relative_dist(header.order_hints[ref], header.order_hint) < 0;
  }
  SavedMotion* saved = saved_motion.data();
  for (int y8 = 0; y8 < h8; ++y8) {
    for (int x8 = 0; x8 < w8; ++x8, ++saved) {
      const BlockInfo& block = *frame.at(2 * y8 + 1, 2 * x8 + 1);
      for (int list = 0; list < 2; ++list) {
        const int ref = block.ref_frame[list];
        if (ref <= INTRA_FRAME || !is_forward[ref]) continue;
        const Mv mv = block.mv[list];
        if (std::abs(mv.row) <= REFMVS_LIMIT && std::abs(mv.col) <= REFMVS_LIMIT) {
          *saved = {mv, static_cast<std::int8_t>(ref)};
        }
      }
    }
  }
  return saved_motion;
}

}  // namespace colmap_av1::av1
