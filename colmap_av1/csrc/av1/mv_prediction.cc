// Motion vector prediction (specification section 7.10) and motion vector syntax (5.11.26,
// 5.11.31, 5.11.32).
#include <algorithm>
#include <cstdlib>
#include <utility>

#include "av1/error.h"
#include "av1/motion_field.h"
#include "av1/spec_tables.h"
#include "av1/tile_parser.h"

namespace colmap_av1::av1 {
namespace {

constexpr int kMaxMv = 1 << 14;  // is_mv_valid( )

bool has_newmv(int mode) {
  return mode == NEWMV || mode == NEW_NEWMV || mode == NEAR_NEWMV || mode == NEW_NEARMV ||
         mode == NEAREST_NEWMV || mode == NEW_NEARESTMV;
}

// 5.11.30 Get mode function
int get_mode(int y_mode, int list) {
  if (list == 0) {
    if (y_mode < NEAREST_NEARESTMV) return y_mode;
    if (y_mode == NEW_NEWMV || y_mode == NEW_NEARESTMV || y_mode == NEW_NEARMV) return NEWMV;
    if (y_mode == NEAREST_NEARESTMV || y_mode == NEAREST_NEWMV) return NEARESTMV;
    if (y_mode == NEAR_NEARMV || y_mode == NEAR_NEWMV) return NEARMV;
    return GLOBALMV;
  }
  if (y_mode == NEW_NEWMV || y_mode == NEAREST_NEWMV || y_mode == NEAR_NEWMV) return NEWMV;
  if (y_mode == NEAREST_NEARESTMV || y_mode == NEW_NEARESTMV) return NEARESTMV;
  if (y_mode == NEAR_NEARMV || y_mode == NEW_NEARMV) return NEARMV;
  return GLOBALMV;
}

Mv negate(Mv mv) {
  return {static_cast<std::int16_t>(-mv.row), static_cast<std::int16_t>(-mv.col)};
}

bool differs_by_16(Mv a, Mv b) {
  return std::abs(a.row - b.row) >= 16 || std::abs(a.col - b.col) >= 16;
}

}  // namespace

// 7.10.2 Find MV stack process
void TileParser::find_mv_stack(bool is_compound) {
  num_mv_found_ = 0;
  new_mv_count_ = 0;
  global_mvs_[0] = setup_global_mv(0);
  if (is_compound) global_mvs_[1] = setup_global_mv(1);
  const auto take_match = [&] { return std::exchange(found_match_, false); };
  found_match_ = false;
  scan_row(-1, is_compound);
  bool found_above = take_match();
  scan_col(-1, is_compound);
  bool found_left = take_match();
  if (std::max(bw4_, bh4_) <= 16) scan_point(-1, bw4_, is_compound);
  found_above |= take_match();
  close_matches_ = found_above + found_left;
  const int num_nearest = num_mv_found_;
  const int num_new = new_mv_count_;
  for (int idx = 0; idx < num_nearest; ++idx) stack_[idx].weight += REF_CAT_LEVEL;
  zero_mv_context_ = 0;
  if (header_->use_ref_frame_mvs) temporal_scan(is_compound);
  scan_point(-1, -1, is_compound);
  found_above |= take_match();
  scan_row(-3, is_compound);
  found_above |= take_match();
  scan_col(-3, is_compound);
  found_left |= take_match();
  if (bh4_ > 1) scan_row(-5, is_compound);
  found_above |= take_match();
  if (bw4_ > 1) scan_col(-5, is_compound);
  found_left |= take_match();
  total_matches_ = found_above + found_left;
  sort_stack(0, num_nearest);
  sort_stack(num_nearest, num_mv_found_);
  if (num_mv_found_ < 2) extra_search(is_compound);
  context_and_clamping(is_compound, num_new);
}

// 7.10.2.1 Setup global MV process
Mv TileParser::setup_global_mv(int ref_list) const {
  const int ref = b_->ref_frame[ref_list];
  const int type = ref > INTRA_FRAME ? header_->gm_type[ref] : IDENTITY;
  if (type == IDENTITY) return {};
  const auto& gm = header_->gm_params[ref];
  Mv mv;
  if (type == TRANSLATION) {
    mv.row = static_cast<std::int16_t>(gm[0] >> (WARPEDMODEL_PREC_BITS - 3));
    mv.col = static_cast<std::int16_t>(gm[1] >> (WARPEDMODEL_PREC_BITS - 3));
  } else {
    const std::int64_t x = b_->mi_col * MI_SIZE + kBlockWidth[b_->mi_size] / 2 - 1;
    const std::int64_t y = b_->mi_row * MI_SIZE + kBlockHeight[b_->mi_size] / 2 - 1;
    constexpr int kOne = 1 << WARPEDMODEL_PREC_BITS;
    const std::int64_t xc = (gm[2] - kOne) * x + gm[3] * y + gm[0];
    const std::int64_t yc = gm[4] * x + (gm[5] - kOne) * y + gm[1];
    const auto round = [&](std::int64_t v) {
      const int shift = WARPEDMODEL_PREC_BITS - (header_->allow_high_precision_mv ? 3 : 2);
      const std::int64_t half = std::int64_t{1} << (shift - 1);
      const std::int64_t rounded = v >= 0 ? (v + half) >> shift : -((-v + half) >> shift);
      return static_cast<std::int16_t>(header_->allow_high_precision_mv ? rounded : rounded * 2);
    };
    mv = {round(yc), round(xc)};
  }
  lower_mv_precision(mv);
  return mv;
}

// 7.10.2.2 Scan row process
void TileParser::scan_row(int delta_row, bool is_compound) {
  const int end4 = std::min({bw4_, header_->mi_cols - b_->mi_col, 16});
  int delta_col = 0;
  int min_len = 1;
  if (std::abs(delta_row) > 1) {
    delta_row += b_->mi_row & 1;
    delta_col = 1 - (b_->mi_col & 1);
  }
  if (std::abs(delta_row) > 1) min_len = 2;
  if (bw4_ >= 16) min_len = 4;
  const int row = b_->mi_row + delta_row;
  for (int i = 0; i < end4;) {
    const int col = b_->mi_col + delta_col + i;
    if (!is_inside(row, col)) break;
    const BlockInfo& candidate = *frame_->at(row, col);
    const int len = std::max(min_len, std::min<int>(bw4_, kNum4x4BlocksWide[candidate.mi_size]));
    add_ref_mv_candidate(candidate, is_compound, len * 2);
    i += len;
  }
}

// 7.10.2.3 Scan col process
void TileParser::scan_col(int delta_col, bool is_compound) {
  const int end4 = std::min({bh4_, header_->mi_rows - b_->mi_row, 16});
  int delta_row = 0;
  int min_len = 1;
  if (std::abs(delta_col) > 1) {
    delta_row = 1 - (b_->mi_row & 1);
    delta_col += b_->mi_col & 1;
  }
  if (std::abs(delta_col) > 1) min_len = 2;
  if (bh4_ >= 16) min_len = 4;
  const int col = b_->mi_col + delta_col;
  for (int i = 0; i < end4;) {
    const int row = b_->mi_row + delta_row + i;
    if (!is_inside(row, col)) break;
    const BlockInfo* candidate = frame_->at(row, col);
    if (candidate == nullptr) break;
    const int len = std::max(min_len, std::min<int>(bh4_, kNum4x4BlocksHigh[candidate->mi_size]));
    add_ref_mv_candidate(*candidate, is_compound, len * 2);
    i += len;
  }
}

// 7.10.2.4 Scan point process
void TileParser::scan_point(int delta_row, int delta_col, bool is_compound) {
  const int row = b_->mi_row + delta_row;
  const int col = b_->mi_col + delta_col;
  if (!is_inside(row, col)) return;
  const BlockInfo* candidate = frame_->at(row, col);
  if (candidate != nullptr) add_ref_mv_candidate(*candidate, is_compound, 4);
}

// 7.10.2.5 Temporal scan process
void TileParser::temporal_scan(bool is_compound) {
  temporal_index_ = -1;
  const auto entries = [&](int row) {
    return frame_->motion_field.data() +
           static_cast<std::ptrdiff_t>(row >> 1) * (header_->mi_cols >> 1);
  };
  const int step_w4 = bw4_ >= 16 ? 4 : 2;
  const int step_h4 = bh4_ >= 16 ? 4 : 2;
  const int end_row = std::min(b_->mi_row + std::min(bh4_, 16), mi_row_end_);
  const int end_col = std::min(b_->mi_col + std::min(bw4_, 16), mi_col_end_);
  zero_mv_context_ = 1;
  for (int row = b_->mi_row; row < end_row; row += step_h4) {
    const MotionFieldEntry* row_entries = entries(row);
    for (int col = b_->mi_col; col < end_col; col += step_w4) {
      const bool first = row == b_->mi_row && col == b_->mi_col;
      temporal_sample(row_entries[col >> 1], first, is_compound);
    }
  }
  const bool allow_extension = bh4_ >= 2 && bh4_ < 16 && bw4_ >= 2 && bw4_ < 16;
  if (!allow_extension) return;
  const int positions[3][2] = {{bh4_, -2}, {bh4_, bw4_}, {bh4_ - 2, bw4_}};
  for (const auto& [delta_row, delta_col] : positions) {
    const int row = (b_->mi_row & 15) + delta_row;  // check_sb_border( )
    const int col = (b_->mi_col & 15) + delta_col;
    if (row < 0 || row >= 16 || col < 0 || col >= 16) continue;
    const int mi_row = b_->mi_row + delta_row;
    const int mi_col = b_->mi_col + delta_col;
    if (is_inside(mi_row, mi_col)) {
      temporal_sample(entries(mi_row)[mi_col >> 1], false, is_compound);
    }
  }
}

// 7.10.2.6 Temporal sample process, of the sample for a unit in the tile. Tiles end at even units,
// so the odd one that is asked for is in the tile as well.
void TileParser::temporal_sample(const MotionFieldEntry& entry, bool first, bool is_compound) {
  if (entry.ref_offset == 0) return;
  // Neighbours often hold the same motion: it projects to the same vectors.
  if (temporal_index_ >= 0 && entry == temporal_entry_) {
    stack_[temporal_index_].weight += 2;
    return;
  }
  std::array<Mv, 2> candidate{};
  bool far = false;
  for (int list = 0; list < 1 + is_compound; ++list) {
    const int distance = frame_->ref_distance[b_->ref_frame[list]];
    candidate[list] = project_mv(entry.mv, projection_factor(distance, entry.ref_offset));
    lower_mv_precision(candidate[list]);
    far |= differs_by_16(candidate[list], global_mvs_[list]);
  }
  if (first) zero_mv_context_ = far;
  temporal_entry_ = entry;
  temporal_index_ = add_to_stack(candidate[0], candidate[1], is_compound, 2);
}

// 7.10.2.7 Add reference motion vector process with 7.10.2.8 and 7.10.2.9, the search stack
// processes
void TileParser::add_ref_mv_candidate(const BlockInfo& candidate, bool is_compound, int weight) {
  if (!candidate.is_inter) return;
  const auto is_large = [&] {
    return std::min(kBlockWidth[candidate.mi_size], kBlockHeight[candidate.mi_size]) >= 8;
  };
  const auto candidate_mv = [&](int cand_list, int list, bool global) {
    Mv mv = global && header_->gm_type[b_->ref_frame[list]] > TRANSLATION && is_large()
                ? global_mvs_[list]
                : candidate.mv[cand_list];
    lower_mv_precision(mv);
    return mv;
  };
  if (is_compound) {
    if (candidate.ref_frame != b_->ref_frame) return;
    const bool global = candidate.y_mode == GLOBAL_GLOBALMV;
    add_to_stack(candidate_mv(0, 0, global), candidate_mv(1, 1, global), true, weight);
    found_match_ = true;
    new_mv_count_ += has_newmv(candidate.y_mode);
    return;
  }
  const bool global = candidate.y_mode == GLOBALMV || candidate.y_mode == GLOBAL_GLOBALMV;
  for (int list = 0; list < 2; ++list) {
    if (candidate.ref_frame[list] != b_->ref_frame[0]) continue;
    add_to_stack(candidate_mv(list, 0, global), {}, false, weight);
    found_match_ = true;
    new_mv_count_ += has_newmv(candidate.y_mode);
  }
}

int TileParser::add_to_stack(Mv mv0, Mv mv1, bool is_compound, int weight) {
  for (int idx = 0; idx < num_mv_found_; ++idx) {
    if (stack_[idx].mv[0] == mv0 && (!is_compound || stack_[idx].mv[1] == mv1)) {
      stack_[idx].weight += weight;
      return idx;
    }
  }
  if (num_mv_found_ == MAX_REF_MV_STACK_SIZE) return -1;
  stack_[num_mv_found_] = {{mv0, mv1}, weight};
  return num_mv_found_++;
}

// 7.10.2.10 Lower precision process
void TileParser::lower_mv_precision(Mv& mv) const {
  if (header_->allow_high_precision_mv) return;
  const auto lower = [&](std::int16_t v) {
    if (header_->force_integer_mv) {
      const int a = ((std::abs(v) + 3) >> 3) << 3;
      return static_cast<std::int16_t>(v > 0 ? a : -a);
    }
    return static_cast<std::int16_t>((v + (v < 0)) & ~1);  // odd ones towards 0
  };
  mv = {lower(mv.row), lower(mv.col)};
}

// 7.10.2.11 Sorting process
void TileParser::sort_stack(int start, int end) {
  while (end > start) {
    int new_end = start;
    for (int idx = start + 1; idx < end; ++idx) {
      if (stack_[idx - 1].weight < stack_[idx].weight) {
        std::swap(stack_[idx - 1], stack_[idx]);
        new_end = idx;
      }
    }
    end = new_end;
  }
}

// 7.10.2.12 Extra search process with 7.10.2.13, the add extra MV candidate process
void TileParser::extra_search(bool is_compound) {
  std::array<std::array<Mv, 2>, 2> ref_id_mvs{};
  std::array<std::array<Mv, 2>, 2> ref_diff_mvs{};
  std::array<int, 2> ref_id_count{};
  std::array<int, 2> ref_diff_count{};
  const auto& sign_bias = header_->ref_frame_sign_bias;
  const auto add_candidate = [&](const BlockInfo& candidate) {
    for (int cand_list = 0; cand_list < 2; ++cand_list) {
      const int cand_ref = candidate.ref_frame[cand_list];
      if (cand_ref <= INTRA_FRAME) continue;
      const Mv cand_mv = candidate.mv[cand_list];
      if (is_compound) {
        for (int list = 0; list < 2; ++list) {
          if (cand_ref == b_->ref_frame[list] && ref_id_count[list] < 2) {
            ref_id_mvs[list][ref_id_count[list]++] = cand_mv;
          } else if (ref_diff_count[list] < 2) {
            const bool flip = sign_bias[cand_ref] != sign_bias[b_->ref_frame[list]];
            ref_diff_mvs[list][ref_diff_count[list]++] = flip ? negate(cand_mv) : cand_mv;
          }
        }
      } else {
        const bool flip = sign_bias[cand_ref] != sign_bias[b_->ref_frame[0]];
        const Mv mv = flip ? negate(cand_mv) : cand_mv;
        bool known = false;
        for (int idx = 0; idx < num_mv_found_; ++idx) known |= stack_[idx].mv[0] == mv;
        if (!known) stack_[num_mv_found_++] = {{mv, Mv{}}, 2};
      }
    }
  };
  const int w4 = std::min({16, bw4_, header_->mi_cols - b_->mi_col});
  const int h4 = std::min({16, bh4_, header_->mi_rows - b_->mi_row});
  const int num4x4 = std::min(w4, h4);
  for (int pass = 0; pass < 2; ++pass) {
    for (int idx = 0; idx < num4x4 && num_mv_found_ < 2;) {
      const int row = pass == 0 ? b_->mi_row - 1 : b_->mi_row + idx;
      const int col = pass == 0 ? b_->mi_col + idx : b_->mi_col - 1;
      if (!is_inside(row, col)) break;
      const BlockInfo& candidate = *frame_->at(row, col);
      add_candidate(candidate);
      idx +=
          pass == 0 ? kNum4x4BlocksWide[candidate.mi_size] : kNum4x4BlocksHigh[candidate.mi_size];
    }
  }
  if (!is_compound) {
    for (int idx = num_mv_found_; idx < 2; ++idx) stack_[idx].mv[0] = global_mvs_[0];
    return;
  }
  std::array<std::array<Mv, 2>, 2> combined{};
  for (int list = 0; list < 2; ++list) {
    int count = 0;
    for (int idx = 0; idx < ref_id_count[list]; ++idx)
      combined[count++][list] = ref_id_mvs[list][idx];
    for (int idx = 0; idx < ref_diff_count[list] && count < 2; ++idx) {
      combined[count++][list] = ref_diff_mvs[list][idx];
    }
    while (count < 2) combined[count++][list] = global_mvs_[list];
  }
  if (num_mv_found_ == 1) {
    const bool same = combined[0] == stack_[0].mv;
    stack_[num_mv_found_++] = {combined[same ? 1 : 0], 2};
  } else {
    for (const auto& mvs : combined) stack_[num_mv_found_++] = {mvs, 2};
  }
}

// 7.10.2.14 Context and clamping process
void TileParser::context_and_clamping(bool is_compound, int num_new) {
  for (int idx = 0; idx < num_mv_found_; ++idx) {
    int z = 0;
    if (idx + 1 < num_mv_found_) {
      if (stack_[idx].weight < REF_CAT_LEVEL) {
        z = 2;
      } else if (stack_[idx + 1].weight < REF_CAT_LEVEL) {
        z = 1;
      }
    }
    drl_context_[idx] = z;
  }
  const int row_border = MV_BORDER + bh4_ * 4 * 8;
  const int col_border = MV_BORDER + bw4_ * 4 * 8;
  const int row_min = -b_->mi_row * MI_SIZE * 8 - row_border;
  const int row_max = (header_->mi_rows - bh4_ - b_->mi_row) * MI_SIZE * 8 + row_border;
  const int col_min = -b_->mi_col * MI_SIZE * 8 - col_border;
  const int col_max = (header_->mi_cols - bw4_ - b_->mi_col) * MI_SIZE * 8 + col_border;
  for (int idx = 0; idx < num_mv_found_; ++idx) {
    for (int list = 0; list < 1 + is_compound; ++list) {
      Mv& mv = stack_[idx].mv[list];
      mv.row = static_cast<std::int16_t>(std::clamp<int>(mv.row, row_min, row_max));
      mv.col = static_cast<std::int16_t>(std::clamp<int>(mv.col, col_min, col_max));
    }
  }
  if (close_matches_ == 0) {
    new_mv_context_ = std::min(total_matches_, 1);
    ref_mv_context_ = total_matches_;
  } else if (close_matches_ == 1) {
    new_mv_context_ = 3 - std::min(num_new, 1);
    ref_mv_context_ = 2 + total_matches_;
  } else {
    new_mv_context_ = 5 - std::min(num_new, 1);
    ref_mv_context_ = 5;
  }
}

// 7.10.3 Has overlappable candidates process
bool TileParser::has_overlappable_candidates() const {
  if (above_) {
    for (int x4 = b_->mi_col; x4 < std::min(header_->mi_cols, b_->mi_col + bw4_); x4 += 2) {
      if (frame_->at(b_->mi_row - 1, x4 | 1)->ref_frame[0] > INTRA_FRAME) return true;
    }
  }
  if (left_) {
    for (int y4 = b_->mi_row; y4 < std::min(header_->mi_rows, b_->mi_row + bh4_); y4 += 2) {
      if (frame_->at(y4 | 1, b_->mi_col - 1)->ref_frame[0] > INTRA_FRAME) return true;
    }
  }
  return false;
}

// 7.10.4 Find warp samples process
void TileParser::find_warp_samples() {
  num_samples_ = num_samples_scanned_ = 0;
  bool do_top_left = true;
  bool do_top_right = true;
  if (above_) {
    const int src_w = kNum4x4BlocksWide[above_->mi_size];
    if (bw4_ <= src_w) {
      const int col_offset = -(b_->mi_col & (src_w - 1));
      if (col_offset < 0) do_top_left = false;
      if (col_offset + src_w > bw4_) do_top_right = false;
      add_warp_sample(-1, 0);
    } else {
      for (int i = 0; i < std::min(bw4_, header_->mi_cols - b_->mi_col);) {
        const BlockInfo& source = *frame_->at(b_->mi_row - 1, b_->mi_col + i);
        add_warp_sample(-1, i);
        i += std::min<int>(bw4_, kNum4x4BlocksWide[source.mi_size]);
      }
    }
  }
  if (left_) {
    const int src_h = kNum4x4BlocksHigh[left_->mi_size];
    if (bh4_ <= src_h) {
      const int row_offset = -(b_->mi_row & (src_h - 1));
      if (row_offset < 0) do_top_left = false;
      add_warp_sample(0, -1);
    } else {
      for (int i = 0; i < std::min(bh4_, header_->mi_rows - b_->mi_row);) {
        const BlockInfo& source = *frame_->at(b_->mi_row + i, b_->mi_col - 1);
        add_warp_sample(i, -1);
        i += std::min<int>(bh4_, kNum4x4BlocksHigh[source.mi_size]);
      }
    }
  }
  if (do_top_left) add_warp_sample(-1, -1);
  if (do_top_right && std::max(bw4_, bh4_) <= 16) add_warp_sample(-1, bw4_);
  if (num_samples_ == 0 && num_samples_scanned_ > 0) num_samples_ = 1;
}

// 7.10.4.2 Add sample process
void TileParser::add_warp_sample(int delta_row, int delta_col) {
  if (num_samples_scanned_ >= LEAST_SQUARES_SAMPLES_MAX) return;
  const int row = b_->mi_row + delta_row;
  const int col = b_->mi_col + delta_col;
  if (!is_inside(row, col)) return;
  const BlockInfo* candidate = frame_->at(row, col);
  if (candidate == nullptr || candidate->ref_frame[0] != b_->ref_frame[0] ||
      candidate->ref_frame[1] != NONE) {
    return;
  }
  const int mid_y = candidate->mi_row * 4 + kNum4x4BlocksHigh[candidate->mi_size] * 2 - 1;
  const int mid_x = candidate->mi_col * 4 + kNum4x4BlocksWide[candidate->mi_size] * 2 - 1;
  const int threshold =
      std::clamp<int>(std::max(kBlockWidth[b_->mi_size], kBlockHeight[b_->mi_size]), 16, 112);
  const Mv mv = candidate->mv[0];
  const bool valid =
      std::abs(mv.row - b_->mv[0].row) + std::abs(mv.col - b_->mv[0].col) <= threshold;
  ++num_samples_scanned_;
  if (!valid && num_samples_scanned_ > 1) return;
  warp_samples_[num_samples_] = {mid_y * 8, mid_x * 8, mid_y * 8 + mv.row, mid_x * 8 + mv.col};
  if (valid) ++num_samples_;
}

// 5.11.26 Assign MV syntax
void TileParser::assign_mv(bool is_compound) {
  for (int list = 0; list < 1 + is_compound; ++list) {
    if (b_->use_intrabc) {
      Mv predicted = stack_[0].mv[0];
      if (predicted == Mv{}) predicted = stack_[1].mv[0];
      if (predicted == Mv{}) {
        const int sb_size4 = seq_->use_128x128_superblock ? 32 : 16;
        if (b_->mi_row - sb_size4 < mi_row_start_) {
          predicted.col =
              static_cast<std::int16_t>(-(sb_size4 * MI_SIZE + INTRABC_DELAY_PIXELS) * 8);
        } else {
          predicted.row = static_cast<std::int16_t>(-(sb_size4 * MI_SIZE * 8));
        }
      }
      read_mv(list, predicted);
      continue;
    }
    const int mode = get_mode(b_->y_mode, list);
    if (mode == GLOBALMV) {
      b_->mv[list] = global_mvs_[list];
      continue;
    }
    const bool first = mode == NEARESTMV || (mode == NEWMV && num_mv_found_ <= 1);
    const Mv predicted = stack_[first ? 0 : ref_mv_idx_].mv[list];
    if (mode == NEWMV) {
      read_mv(list, predicted);
    } else {
      b_->mv[list] = predicted;
    }
  }
  if (!is_mv_valid(is_compound)) throw BitstreamError("motion vector is out of range");
}

// 5.11.31 MV syntax
void TileParser::read_mv(int list, Mv predicted) {
  MvCdfs& cdf = cdf_.mv[b_->use_intrabc ? MV_INTRABC_CONTEXT : 0];
  const int mv_joint = read(cdf.joint);
  int row = predicted.row;
  int col = predicted.col;
  if (mv_joint == MV_JOINT_HZVNZ || mv_joint == MV_JOINT_HNZVNZ) {
    row += read_mv_component(cdf.component[0]);
  }
  if (mv_joint == MV_JOINT_HNZVZ || mv_joint == MV_JOINT_HNZVNZ) {
    col += read_mv_component(cdf.component[1]);
  }
  if (std::abs(row) >= kMaxMv || std::abs(col) >= kMaxMv) {
    throw BitstreamError("motion vector is out of range");
  }
  b_->mv[list] = {static_cast<std::int16_t>(row), static_cast<std::int16_t>(col)};
}

// 5.11.32 MV component syntax
int TileParser::read_mv_component(MvComponentCdfs& cdf) {
  const bool mv_sign = read_flag(cdf.sign);
  const int mv_class = read(cdf.mv_class);
  int mag = 0;
  int d = 0;
  int fr = 3;
  int hp = 1;
  if (mv_class == MV_CLASS_0) {
    d = read(cdf.class0_bit);
    if (!header_->force_integer_mv) fr = read(cdf.class0_fr[d]);
    if (header_->allow_high_precision_mv) hp = read(cdf.class0_hp);
  } else {
    for (int i = 0; i < mv_class; ++i) d |= read(cdf.bits[i]) << i;
    mag = CLASS0_SIZE << (mv_class + 2);
    if (!header_->force_integer_mv) fr = read(cdf.fr);
    if (header_->allow_high_precision_mv) hp = read(cdf.hp);
  }
  mag += ((d << 3) | (fr << 1) | hp) + 1;
  return mv_sign ? -mag : mag;
}

// is_mv_valid( ) of the semantics of assign_mv (6.10.25)
bool TileParser::is_mv_valid(bool is_compound) const {
  for (int list = 0; list < 1 + is_compound; ++list) {
    if (std::abs(b_->mv[list].row) >= kMaxMv || std::abs(b_->mv[list].col) >= kMaxMv) return false;
  }
  if (!b_->use_intrabc) return true;
  const Mv mv = b_->mv[0];
  const int bw = kBlockWidth[b_->mi_size];
  const int bh = kBlockHeight[b_->mi_size];
  if ((mv.row & 7) || (mv.col & 7)) return false;
  int src_top = b_->mi_row * MI_SIZE + (mv.row >> 3);
  int src_left = b_->mi_col * MI_SIZE + (mv.col >> 3);
  const int src_bottom = src_top + bh;
  const int src_right = src_left + bw;
  if (b_->has_chroma) {
    if (bw < 8 && seq_->subsampling_x) src_left -= 4;
    if (bh < 8 && seq_->subsampling_y) src_top -= 4;
  }
  if (src_top < mi_row_start_ * MI_SIZE || src_left < mi_col_start_ * MI_SIZE ||
      src_bottom > mi_row_end_ * MI_SIZE || src_right > mi_col_end_ * MI_SIZE) {
    return false;
  }
  const int sb_h = seq_->use_128x128_superblock ? 128 : 64;
  const int active_sb_row = (b_->mi_row * MI_SIZE) / sb_h;
  const int active_sb64_col = (b_->mi_col * MI_SIZE) >> 6;
  const int src_sb_row = (src_bottom - 1) / sb_h;
  const int src_sb64_col = (src_right - 1) >> 6;
  const int total_sb64_per_row = ((mi_col_end_ - mi_col_start_ - 1) >> 4) + 1;
  const int active_sb64 = active_sb_row * total_sb64_per_row + active_sb64_col;
  const int src_sb64 = src_sb_row * total_sb64_per_row + src_sb64_col;
  if (src_sb64 >= active_sb64 - INTRABC_DELAY_SB64) return false;
  const int gradient = 1 + INTRABC_DELAY_SB64 + seq_->use_128x128_superblock;
  const int wf_offset = gradient * (active_sb_row - src_sb_row);
  return src_sb_row <= active_sb_row &&
         src_sb64_col < active_sb64_col - INTRABC_DELAY_SB64 + wf_offset;
}

}  // namespace colmap_av1::av1
