#include "av1/mv_prediction.h"

#include <algorithm>
#include <cstdlib>
#include <utility>

#include "av1/motion_field.h"
#include "av1/spec_tables.h"

namespace colmap_av1::av1 {
namespace {

bool has_newmv(int mode) {
  return mode == NEWMV || mode == NEW_NEWMV || mode == NEAR_NEWMV || mode == NEW_NEARMV ||
         mode == NEAREST_NEWMV || mode == NEW_NEARESTMV;
}

Mv negate(Mv mv) {
  return {static_cast<std::int16_t>(-mv.row), static_cast<std::int16_t>(-mv.col)};
}

bool differs_by_16(Mv a, Mv b) {
  return std::abs(a.row - b.row) >= 16 || std::abs(a.col - b.col) >= 16;
}

// The find MV stack process for one block.
class MvStackFinder {
 public:
  MvStackFinder(const FrameContext& frame, const TileBounds& tile, const BlockInfo& block)
      : frame_(frame),
        header_(*frame.header),
        tile_(tile),
        block_(block),
        bw4_(block.bw4()),
        bh4_(block.bh4()),
        is_compound_(block.is_compound()) {}

  MvStack find();

 private:
  Mv setup_global_mv(int ref_list) const;
  void scan_row(int delta_row);
  void scan_col(int delta_col);
  void scan_point(int delta_row, int delta_col);
  void temporal_scan();
  void temporal_sample(const MotionFieldEntry& entry, bool first);
  void add_ref_mv_candidate(const BlockInfo& candidate, int weight);
  // Returns the index of the entry, or -1 if the stack is full.
  int add_to_stack(Mv mv0, Mv mv1, int weight);
  Mv lower_mv_precision(Mv mv) const;
  void sort_stack(int start, int end);
  void extra_search();
  void context_and_clamping(int num_new);

  const FrameContext& frame_;
  const FrameHeader& header_;
  const TileBounds tile_;
  const BlockInfo& block_;
  const int bw4_;
  const int bh4_;
  const bool is_compound_;
  MvStack stack_;
  int new_mv_count_ = 0;
  MotionFieldEntry temporal_entry_;  // the last one projected, and its index in the stack
  int temporal_index_ = -1;
  bool found_match_ = false;
  int close_matches_ = 0;
  int total_matches_ = 0;
};

MvStack MvStackFinder::find() {
  stack_.global_mvs[0] = setup_global_mv(0);
  if (is_compound_) stack_.global_mvs[1] = setup_global_mv(1);
  const auto take_match = [&] { return std::exchange(found_match_, false); };
  scan_row(-1);
  bool found_above = take_match();
  scan_col(-1);
  bool found_left = take_match();
  if (std::max(bw4_, bh4_) <= 16) scan_point(-1, bw4_);
  found_above |= take_match();
  close_matches_ = found_above + found_left;
  const int num_nearest = stack_.num_mv_found;
  const int num_new = new_mv_count_;
  for (int idx = 0; idx < num_nearest; ++idx) stack_.entries[idx].weight += REF_CAT_LEVEL;
  if (header_.use_ref_frame_mvs) temporal_scan();
  scan_point(-1, -1);
  found_above |= take_match();
  scan_row(-3);
  found_above |= take_match();
  scan_col(-3);
  found_left |= take_match();
  if (bh4_ > 1) scan_row(-5);
  found_above |= take_match();
  if (bw4_ > 1) scan_col(-5);
  found_left |= take_match();
  total_matches_ = found_above + found_left;
  sort_stack(0, num_nearest);
  sort_stack(num_nearest, stack_.num_mv_found);
  if (stack_.num_mv_found < 2) extra_search();
  context_and_clamping(num_new);
  return stack_;
}

// 7.10.2.1 Setup global MV process
Mv MvStackFinder::setup_global_mv(int ref_list) const {
  const int ref = block_.ref_frame[ref_list];
  const int type = ref > INTRA_FRAME ? header_.gm_type[ref] : IDENTITY;
  if (type == IDENTITY) return {};
  const auto& gm = header_.gm_params[ref];
  Mv mv;
  if (type == TRANSLATION) {
    mv.row = static_cast<std::int16_t>(gm[0] >> (WARPEDMODEL_PREC_BITS - 3));
    mv.col = static_cast<std::int16_t>(gm[1] >> (WARPEDMODEL_PREC_BITS - 3));
  } else {
    const std::int64_t x = block_.mi_col * MI_SIZE + kBlockWidth[block_.mi_size] / 2 - 1;
    const std::int64_t y = block_.mi_row * MI_SIZE + kBlockHeight[block_.mi_size] / 2 - 1;
    constexpr int kOne = 1 << WARPEDMODEL_PREC_BITS;
    const std::int64_t xc = (gm[2] - kOne) * x + gm[3] * y + gm[0];
    const std::int64_t yc = gm[4] * x + (gm[5] - kOne) * y + gm[1];
    const auto round = [&](std::int64_t v) {
      const int shift = WARPEDMODEL_PREC_BITS - (header_.allow_high_precision_mv ? 3 : 2);
      const std::int64_t half = std::int64_t{1} << (shift - 1);
      const std::int64_t rounded = v >= 0 ? (v + half) >> shift : -((-v + half) >> shift);
      return static_cast<std::int16_t>(header_.allow_high_precision_mv ? rounded : rounded * 2);
    };
    mv = {round(yc), round(xc)};
  }
  return lower_mv_precision(mv);
}

// 7.10.2.2 Scan row process
void MvStackFinder::scan_row(int delta_row) {
  const int end4 = std::min({bw4_, header_.mi_cols - block_.mi_col, 16});
  int delta_col = 0;
  int min_len = 1;
  if (std::abs(delta_row) > 1) {
    delta_row += block_.mi_row & 1;
    delta_col = 1 - (block_.mi_col & 1);
  }
  if (std::abs(delta_row) > 1) min_len = 2;
  if (bw4_ >= 16) min_len = 4;
  const int row = block_.mi_row + delta_row;
  for (int i = 0; i < end4;) {
    const int col = block_.mi_col + delta_col + i;
    if (!tile_.contains(row, col)) break;
    const BlockInfo& candidate = *frame_.at(row, col);
    const int len = std::max(min_len, std::min<int>(bw4_, kNum4x4BlocksWide[candidate.mi_size]));
    add_ref_mv_candidate(candidate, len * 2);
    i += len;
  }
}

// 7.10.2.3 Scan col process
void MvStackFinder::scan_col(int delta_col) {
  const int end4 = std::min({bh4_, header_.mi_rows - block_.mi_row, 16});
  int delta_row = 0;
  int min_len = 1;
  if (std::abs(delta_col) > 1) {
    delta_row = 1 - (block_.mi_row & 1);
    delta_col += block_.mi_col & 1;
  }
  if (std::abs(delta_col) > 1) min_len = 2;
  if (bh4_ >= 16) min_len = 4;
  const int col = block_.mi_col + delta_col;
  for (int i = 0; i < end4;) {
    const int row = block_.mi_row + delta_row + i;
    if (!tile_.contains(row, col)) break;
    const BlockInfo* candidate = frame_.at(row, col);
    if (candidate == nullptr) break;
    const int len = std::max(min_len, std::min<int>(bh4_, kNum4x4BlocksHigh[candidate->mi_size]));
    add_ref_mv_candidate(*candidate, len * 2);
    i += len;
  }
}

// 7.10.2.4 Scan point process
void MvStackFinder::scan_point(int delta_row, int delta_col) {
  const int row = block_.mi_row + delta_row;
  const int col = block_.mi_col + delta_col;
  if (!tile_.contains(row, col)) return;
  const BlockInfo* candidate = frame_.at(row, col);
  if (candidate != nullptr) add_ref_mv_candidate(*candidate, 4);
}

// 7.10.2.5 Temporal scan process
void MvStackFinder::temporal_scan() {
  const auto entries = [&](int row) {
    return frame_.motion_field.data() +
           static_cast<std::ptrdiff_t>(row >> 1) * (header_.mi_cols >> 1);
  };
  const int step_w4 = bw4_ >= 16 ? 4 : 2;
  const int step_h4 = bh4_ >= 16 ? 4 : 2;
  const int end_row = std::min(block_.mi_row + std::min(bh4_, 16), tile_.mi_row_end);
  const int end_col = std::min(block_.mi_col + std::min(bw4_, 16), tile_.mi_col_end);
  stack_.zero_mv_context = 1;
  for (int row = block_.mi_row; row < end_row; row += step_h4) {
    const MotionFieldEntry* row_entries = entries(row);
    for (int col = block_.mi_col; col < end_col; col += step_w4) {
      const bool first = row == block_.mi_row && col == block_.mi_col;
      temporal_sample(row_entries[col >> 1], first);
    }
  }
  const bool allow_extension = bh4_ >= 2 && bh4_ < 16 && bw4_ >= 2 && bw4_ < 16;
  if (!allow_extension) return;
  const int positions[3][2] = {{bh4_, -2}, {bh4_, bw4_}, {bh4_ - 2, bw4_}};
  for (const auto& [delta_row, delta_col] : positions) {
    const int row = (block_.mi_row & 15) + delta_row;  // check_sb_border( )
    const int col = (block_.mi_col & 15) + delta_col;
    if (row < 0 || row >= 16 || col < 0 || col >= 16) continue;
    const int mi_row = block_.mi_row + delta_row;
    const int mi_col = block_.mi_col + delta_col;
    if (tile_.contains(mi_row, mi_col)) {
      temporal_sample(entries(mi_row)[mi_col >> 1], false);
    }
  }
}

// 7.10.2.6 Temporal sample process, for a unit in the tile. Tiles end at even units, so the odd
// unit that the process reads is in the tile as well.
void MvStackFinder::temporal_sample(const MotionFieldEntry& entry, bool first) {
  if (entry.ref_offset == 0) return;
  // Neighbours often have the same motion, whose projection is in the stack already.
  if (temporal_index_ >= 0 && entry == temporal_entry_) {
    stack_.entries[temporal_index_].weight += 2;
    return;
  }
  std::array<Mv, 2> candidate{};
  bool far = false;
  for (int list = 0; list < 1 + is_compound_; ++list) {
    const int distance = frame_.ref_distance[block_.ref_frame[list]];
    candidate[list] =
        lower_mv_precision(project_mv(entry.mv, projection_factor(distance, entry.ref_offset)));
    far |= differs_by_16(candidate[list], stack_.global_mvs[list]);
  }
  if (first) stack_.zero_mv_context = far;
  temporal_entry_ = entry;
  temporal_index_ = add_to_stack(candidate[0], candidate[1], 2);
}

// 7.10.2.7 Add reference motion vector process with 7.10.2.8 and 7.10.2.9, the search stack
// processes
void MvStackFinder::add_ref_mv_candidate(const BlockInfo& candidate, int weight) {
  if (!candidate.is_inter) return;
  const auto candidate_mv = [&](int cand_list, int list, bool global) {
    return lower_mv_precision(global && header_.gm_type[block_.ref_frame[list]] > TRANSLATION &&
                                      candidate.is_at_least_8x8()
                                  ? stack_.global_mvs[list]
                                  : candidate.mv[cand_list]);
  };
  if (is_compound_) {
    if (candidate.ref_frame != block_.ref_frame) return;
    const bool global = candidate.y_mode == GLOBAL_GLOBALMV;
    add_to_stack(candidate_mv(0, 0, global), candidate_mv(1, 1, global), weight);
    found_match_ = true;
    new_mv_count_ += has_newmv(candidate.y_mode);
    return;
  }
  const bool global = candidate.y_mode == GLOBALMV || candidate.y_mode == GLOBAL_GLOBALMV;
  for (int list = 0; list < 2; ++list) {
    if (candidate.ref_frame[list] != block_.ref_frame[0]) continue;
    add_to_stack(candidate_mv(list, 0, global), {}, weight);
    found_match_ = true;
    new_mv_count_ += has_newmv(candidate.y_mode);
  }
}

int MvStackFinder::add_to_stack(Mv mv0, Mv mv1, int weight) {
  for (int idx = 0; idx < stack_.num_mv_found; ++idx) {
    if (stack_.entries[idx].mv[0] == mv0 && (!is_compound_ || stack_.entries[idx].mv[1] == mv1)) {
      stack_.entries[idx].weight += weight;
      return idx;
    }
  }
  if (stack_.num_mv_found == MAX_REF_MV_STACK_SIZE) return -1;
  stack_.entries[stack_.num_mv_found] = {{mv0, mv1}, weight};
  return stack_.num_mv_found++;
}

// 7.10.2.10 Lower precision process
Mv MvStackFinder::lower_mv_precision(Mv mv) const {
  if (header_.allow_high_precision_mv) return mv;
  const auto lower = [&](std::int16_t v) {
    if (header_.force_integer_mv) {
      const int a = ((std::abs(v) + 3) >> 3) << 3;
      return static_cast<std::int16_t>(v > 0 ? a : -a);
    }
    return static_cast<std::int16_t>((v + (v < 0)) & ~1);  // odd values are rounded towards 0
  };
  return {lower(mv.row), lower(mv.col)};
}

// 7.10.2.11 Sorting process
void MvStackFinder::sort_stack(int start, int end) {
  while (end > start) {
    int new_end = start;
    for (int idx = start + 1; idx < end; ++idx) {
      if (stack_.entries[idx - 1].weight < stack_.entries[idx].weight) {
        std::swap(stack_.entries[idx - 1], stack_.entries[idx]);
        new_end = idx;
      }
    }
    end = new_end;
  }
}

// 7.10.2.12 Extra search process with 7.10.2.13, the add extra MV candidate process
void MvStackFinder::extra_search() {
  std::array<std::array<Mv, 2>, 2> ref_id_mvs{};
  std::array<std::array<Mv, 2>, 2> ref_diff_mvs{};
  std::array<int, 2> ref_id_count{};
  std::array<int, 2> ref_diff_count{};
  const auto& sign_bias = header_.ref_frame_sign_bias;
  const auto add_candidate = [&](const BlockInfo& candidate) {
    for (int cand_list = 0; cand_list < 2; ++cand_list) {
      const int cand_ref = candidate.ref_frame[cand_list];
      if (cand_ref <= INTRA_FRAME) continue;
      const Mv cand_mv = candidate.mv[cand_list];
      if (is_compound_) {
        for (int list = 0; list < 2; ++list) {
          if (cand_ref == block_.ref_frame[list] && ref_id_count[list] < 2) {
            ref_id_mvs[list][ref_id_count[list]++] = cand_mv;
          } else if (ref_diff_count[list] < 2) {
            const bool flip = sign_bias[cand_ref] != sign_bias[block_.ref_frame[list]];
            ref_diff_mvs[list][ref_diff_count[list]++] = flip ? negate(cand_mv) : cand_mv;
          }
        }
      } else {
        const bool flip = sign_bias[cand_ref] != sign_bias[block_.ref_frame[0]];
        const Mv mv = flip ? negate(cand_mv) : cand_mv;
        bool known = false;
        for (int idx = 0; idx < stack_.num_mv_found; ++idx)
          known |= stack_.entries[idx].mv[0] == mv;
        if (!known) stack_.entries[stack_.num_mv_found++] = {{mv, Mv{}}, 2};
      }
    }
  };
  const int w4 = std::min({16, bw4_, header_.mi_cols - block_.mi_col});
  const int h4 = std::min({16, bh4_, header_.mi_rows - block_.mi_row});
  const int num4x4 = std::min(w4, h4);
  for (int pass = 0; pass < 2; ++pass) {
    for (int idx = 0; idx < num4x4 && stack_.num_mv_found < 2;) {
      const int row = pass == 0 ? block_.mi_row - 1 : block_.mi_row + idx;
      const int col = pass == 0 ? block_.mi_col + idx : block_.mi_col - 1;
      if (!tile_.contains(row, col)) break;
      const BlockInfo& candidate = *frame_.at(row, col);
      add_candidate(candidate);
      idx +=
          pass == 0 ? kNum4x4BlocksWide[candidate.mi_size] : kNum4x4BlocksHigh[candidate.mi_size];
    }
  }
  if (!is_compound_) {
    for (int idx = stack_.num_mv_found; idx < 2; ++idx)
      stack_.entries[idx].mv[0] = stack_.global_mvs[0];
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
    while (count < 2) combined[count++][list] = stack_.global_mvs[list];
  }
  if (stack_.num_mv_found == 1) {
    const bool same = combined[0] == stack_.entries[0].mv;
    stack_.entries[stack_.num_mv_found++] = {combined[same ? 1 : 0], 2};
  } else {
    for (const auto& mvs : combined) stack_.entries[stack_.num_mv_found++] = {mvs, 2};
  }
}

// 7.10.2.14 Context and clamping process
void MvStackFinder::context_and_clamping(int num_new) {
  for (int idx = 0; idx < stack_.num_mv_found; ++idx) {
    int z = 0;
    if (idx + 1 < stack_.num_mv_found) {
      if (stack_.entries[idx].weight < REF_CAT_LEVEL) {
        z = 2;
      } else if (stack_.entries[idx + 1].weight < REF_CAT_LEVEL) {
        z = 1;
      }
    }
    stack_.drl_context[idx] = z;
  }
  const int row_border = MV_BORDER + bh4_ * 4 * 8;
  const int col_border = MV_BORDER + bw4_ * 4 * 8;
  const int row_min = -block_.mi_row * MI_SIZE * 8 - row_border;
  const int row_max = (header_.mi_rows - bh4_ - block_.mi_row) * MI_SIZE * 8 + row_border;
  const int col_min = -block_.mi_col * MI_SIZE * 8 - col_border;
  const int col_max = (header_.mi_cols - bw4_ - block_.mi_col) * MI_SIZE * 8 + col_border;
  for (int idx = 0; idx < stack_.num_mv_found; ++idx) {
    for (int list = 0; list < 1 + is_compound_; ++list) {
      Mv& mv = stack_.entries[idx].mv[list];
      mv.row = static_cast<std::int16_t>(std::clamp<int>(mv.row, row_min, row_max));
      mv.col = static_cast<std::int16_t>(std::clamp<int>(mv.col, col_min, col_max));
    }
  }
  if (close_matches_ == 0) {
    stack_.new_mv_context = std::min(total_matches_, 1);
    stack_.ref_mv_context = total_matches_;
  } else if (close_matches_ == 1) {
    stack_.new_mv_context = 3 - std::min(num_new, 1);
    stack_.ref_mv_context = 2 + total_matches_;
  } else {
    stack_.new_mv_context = 5 - std::min(num_new, 1);
    stack_.ref_mv_context = 5;
  }
}

}  // namespace

// 7.10.2 Find MV stack process
MvStack find_mv_stack(const FrameContext& frame, const TileBounds& tile, const BlockInfo& block) {
  return MvStackFinder(frame, tile, block).find();
}

// 7.10.3 Has overlappable candidates process
bool has_overlappable_candidates(const FrameContext& frame, const BlockInfo& block,
                                 const BlockInfo* above, const BlockInfo* left) {
  const FrameHeader& header = *frame.header;
  if (above != nullptr) {
    for (int x4 = block.mi_col; x4 < std::min(header.mi_cols, block.mi_col + block.bw4());
         x4 += 2) {
      if (frame.at(block.mi_row - 1, x4 | 1)->ref_frame[0] > INTRA_FRAME) return true;
    }
  }
  if (left != nullptr) {
    for (int y4 = block.mi_row; y4 < std::min(header.mi_rows, block.mi_row + block.bh4());
         y4 += 2) {
      if (frame.at(y4 | 1, block.mi_col - 1)->ref_frame[0] > INTRA_FRAME) return true;
    }
  }
  return false;
}

// 7.10.4 Find warp samples process
WarpSamples find_warp_samples(const FrameContext& frame, const TileBounds& tile,
                              const BlockInfo& block, const BlockInfo* above,
                              const BlockInfo* left) {
  const FrameHeader& header = *frame.header;
  const int bw4 = block.bw4();
  const int bh4 = block.bh4();
  WarpSamples found;
  int num_scanned = 0;
  // 7.10.4.2 Add sample process
  const auto add = [&](int delta_row, int delta_col) {
    if (num_scanned >= LEAST_SQUARES_SAMPLES_MAX) return;
    const int row = block.mi_row + delta_row;
    const int col = block.mi_col + delta_col;
    if (!tile.contains(row, col)) return;
    const BlockInfo* candidate = frame.at(row, col);
    if (candidate == nullptr || candidate->ref_frame[0] != block.ref_frame[0] ||
        candidate->ref_frame[1] != NONE) {
      return;
    }
    const int y = (candidate->mi_row * 4 + candidate->bh4() * 2 - 1) * 8;
    const int x = (candidate->mi_col * 4 + candidate->bw4() * 2 - 1) * 8;
    const int threshold =
        std::clamp<int>(std::max(kBlockWidth[block.mi_size], kBlockHeight[block.mi_size]), 16, 112);
    const Mv mv = candidate->mv[0];
    const bool valid =
        std::abs(mv.row - block.mv[0].row) + std::abs(mv.col - block.mv[0].col) <= threshold;
    ++num_scanned;
    if (!valid && num_scanned > 1) return;
    found.samples[found.count] = {y, x, y + mv.row, x + mv.col};
    if (valid) ++found.count;
  };
  bool do_top_left = true;
  bool do_top_right = true;
  if (above != nullptr) {
    const int src_w = above->bw4();
    if (bw4 <= src_w) {
      const int col_offset = -(block.mi_col & (src_w - 1));
      if (col_offset < 0) do_top_left = false;
      if (col_offset + src_w > bw4) do_top_right = false;
      add(-1, 0);
    } else {
      for (int i = 0; i < std::min(bw4, header.mi_cols - block.mi_col);) {
        const BlockInfo& source = *frame.at(block.mi_row - 1, block.mi_col + i);
        add(-1, i);
        i += std::min(bw4, source.bw4());
      }
    }
  }
  if (left != nullptr) {
    const int src_h = left->bh4();
    if (bh4 <= src_h) {
      const int row_offset = -(block.mi_row & (src_h - 1));
      if (row_offset < 0) do_top_left = false;
      add(0, -1);
    } else {
      for (int i = 0; i < std::min(bh4, header.mi_rows - block.mi_row);) {
        const BlockInfo& source = *frame.at(block.mi_row + i, block.mi_col - 1);
        add(i, -1);
        i += std::min(bh4, source.bh4());
      }
    }
  }
  if (do_top_left) add(-1, -1);
  if (do_top_right && std::max(bw4, bh4) <= 16) add(-1, bw4);
  if (found.count == 0 && num_scanned > 0) found.count = 1;
  return found;
}

}  // namespace colmap_av1::av1
