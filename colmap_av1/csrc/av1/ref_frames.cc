// Reference frames of inter blocks (specification section 5.11.25 and the contexts of 8.3.2).
#include <algorithm>

#include "av1/error.h"
#include "av1/spec_tables.h"
#include "av1/tile_parser.h"

namespace colmap_av1::av1 {
namespace {

bool check_backward(int ref_frame) {
  return ref_frame >= BWDREF_FRAME && ref_frame <= ALTREF_FRAME;
}

bool is_samedir_ref_pair(int ref0, int ref1) {
  return (ref0 >= BWDREF_FRAME) == (ref1 >= BWDREF_FRAME);
}

int ref_count_ctx(int counts0, int counts1) {
  return counts0 < counts1 ? 0 : counts0 == counts1 ? 1 : 2;
}

}  // namespace

int TileParser::comp_mode_context() const {
  if (above_ && left_) {
    if (above_single_ && left_single_) {
      return check_backward(above_ref_frame_[0]) ^ check_backward(left_ref_frame_[0]);
    }
    if (above_single_) return 2 + (check_backward(above_ref_frame_[0]) || above_intra_);
    if (left_single_) return 2 + (check_backward(left_ref_frame_[0]) || left_intra_);
    return 4;
  }
  if (above_) return above_single_ ? check_backward(above_ref_frame_[0]) : 3;
  if (left_) return left_single_ ? check_backward(left_ref_frame_[0]) : 3;
  return 1;
}

int TileParser::comp_ref_type_context() const {
  const int above0 = above_ref_frame_[0];
  const int left0 = left_ref_frame_[0];
  const bool above_comp_inter = above_ && !above_intra_ && !above_single_;
  const bool left_comp_inter = left_ && !left_intra_ && !left_single_;
  const bool above_uni_comp = above_comp_inter && is_samedir_ref_pair(above0, above_ref_frame_[1]);
  const bool left_uni_comp = left_comp_inter && is_samedir_ref_pair(left0, left_ref_frame_[1]);
  if (above_ && !above_intra_ && left_ && !left_intra_) {
    const bool samedir = is_samedir_ref_pair(above0, left0);
    if (!above_comp_inter && !left_comp_inter) return 1 + 2 * samedir;
    if (!above_comp_inter) return !left_uni_comp ? 1 : 3 + samedir;
    if (!left_comp_inter) return !above_uni_comp ? 1 : 3 + samedir;
    if (!above_uni_comp && !left_uni_comp) return 0;
    if (!above_uni_comp || !left_uni_comp) return 2;
    return 3 + ((above0 == BWDREF_FRAME) == (left0 == BWDREF_FRAME));
  }
  if (above_ && left_) {
    if (above_comp_inter) return 1 + 2 * above_uni_comp;
    if (left_comp_inter) return 1 + 2 * left_uni_comp;
    return 2;
  }
  if (above_comp_inter) return 4 * above_uni_comp;
  if (left_comp_inter) return 4 * left_uni_comp;
  return 2;
}

// 5.11.25 Ref frames syntax
void TileParser::read_ref_frames() {
  const auto set = [&](int ref0, int ref1) {
    b_->ref_frame = {static_cast<std::int8_t>(ref0), static_cast<std::int8_t>(ref1)};
    if (!frame_->ref_usable[ref0] || (ref1 > INTRA_FRAME && !frame_->ref_usable[ref1])) {
      throw BitstreamError("block refers to a frame that is missing or has an unsuitable size");
    }
  };
  if (b_->skip_mode) return set(header_->skip_mode_frame[0], header_->skip_mode_frame[1]);
  if (seg_feature_active(SEG_LVL_REF_FRAME)) {
    return set(header_->segmentation.feature_data[b_->segment_id][SEG_LVL_REF_FRAME], NONE);
  }
  if (seg_feature_active(SEG_LVL_SKIP) || seg_feature_active(SEG_LVL_GLOBALMV)) {
    return set(LAST_FRAME, NONE);
  }
  ref_counts_.fill(0);
  const auto count = [&](const BlockInfo* neighbour) {
    if (!neighbour) return;
    for (const int ref : neighbour->ref_frame) {
      if (ref > INTRA_FRAME) ++ref_counts_[ref];
    }
  };
  count(above_);
  count(left_);
  const auto& n = ref_counts_;
  const int last = n[LAST_FRAME];
  const int last2 = n[LAST2_FRAME];
  const int last3 = n[LAST3_FRAME];
  const int gold = n[GOLDEN_FRAME];
  const int bwd = n[BWDREF_FRAME];
  const int alt2 = n[ALTREF2_FRAME];
  const int alt = n[ALTREF_FRAME];
  const int ctx_last_or_last3 = ref_count_ctx(last + last2, last3 + gold);  // comp_ref
  const int ctx_last = ref_count_ctx(last, last2);                          // comp_ref_p1
  const int ctx_last3 = ref_count_ctx(last3, gold);                         // comp_ref_p2
  const int ctx_bwd_or_alt = ref_count_ctx(bwd + alt2, alt);                // comp_bwdref
  const int ctx_bwd = ref_count_ctx(bwd, alt2);                             // comp_bwdref_p1
  const int ctx_direction =
      ref_count_ctx(last + last2 + last3 + gold, bwd + alt2 + alt);  // single_ref_p1

  const bool may_be_compound = header_->reference_select && std::min(bw4_, bh4_) >= 2;
  if (may_be_compound && read_flag(cdf_.comp_mode[comp_mode_context()])) {
    if (read(cdf_.comp_ref_type[comp_ref_type_context()]) == UNIDIR_COMP_REFERENCE) {
      if (read_flag(cdf_.uni_comp_ref[ctx_direction][0])) return set(BWDREF_FRAME, ALTREF_FRAME);
      if (!read_flag(cdf_.uni_comp_ref[ref_count_ctx(last2, last3 + gold)][1])) {
        return set(LAST_FRAME, LAST2_FRAME);
      }
      const bool golden = read_flag(cdf_.uni_comp_ref[ctx_last3][2]);
      return set(LAST_FRAME, golden ? GOLDEN_FRAME : LAST3_FRAME);
    }
    int ref0;
    if (!read_flag(cdf_.comp_ref[ctx_last_or_last3][0])) {
      ref0 = read_flag(cdf_.comp_ref[ctx_last][1]) ? LAST2_FRAME : LAST_FRAME;
    } else {
      ref0 = read_flag(cdf_.comp_ref[ctx_last3][2]) ? GOLDEN_FRAME : LAST3_FRAME;
    }
    int ref1 = ALTREF_FRAME;
    if (!read_flag(cdf_.comp_bwd_ref[ctx_bwd_or_alt][0])) {
      ref1 = read_flag(cdf_.comp_bwd_ref[ctx_bwd][1]) ? ALTREF2_FRAME : BWDREF_FRAME;
    }
    return set(ref0, ref1);
  }
  if (read_flag(cdf_.single_ref[ctx_direction][0])) {
    if (read_flag(cdf_.single_ref[ctx_bwd_or_alt][1])) return set(ALTREF_FRAME, NONE);
    return set(read_flag(cdf_.single_ref[ctx_bwd][5]) ? ALTREF2_FRAME : BWDREF_FRAME, NONE);
  }
  if (read_flag(cdf_.single_ref[ctx_last_or_last3][2])) {
    return set(read_flag(cdf_.single_ref[ctx_last3][4]) ? GOLDEN_FRAME : LAST3_FRAME, NONE);
  }
  return set(read_flag(cdf_.single_ref[ctx_last][3]) ? LAST2_FRAME : LAST_FRAME, NONE);
}

}  // namespace colmap_av1::av1
