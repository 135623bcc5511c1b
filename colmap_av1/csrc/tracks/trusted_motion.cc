#include "tracks/trusted_motion.h"

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <iterator>
#include <limits>
#include <optional>
#include <vector>

#include "av1/constants.h"
#include "av1/spec_tables.h"
#include "tracks/affine_motion.h"
#include "tracks/displacement.h"
#include "tracks/fill_motion.h"
#include "tracks/trust.h"

namespace colmap_av1::tracks {
namespace {

using Verdict = TrustScratch::Verdict;

// Approximate number of sampled units that show whether a frame has detail, and its affine motion.
constexpr int kSpreadSamples = 2048;
constexpr int kSuperblock = 16;  // in units; the smaller of the two sizes
// If a smaller share of the sampled units is in small blocks, the picture shows no detail, or it
// repeats another one exactly. For a camera that stands still, the share is at least 0.02.
constexpr double kDetail = 0.01;
// Intra blocks of this area show no detail either: encoders code even black in blocks of 32x32.
constexpr int kPlainIntraArea = 1024;
// A picture repeats the one that it refers to if at most this share of the sampled units has a
// residual. If it shows something else without detail, such as black, all of them have one.
constexpr double kRepeat = 0.2;

// How the motion of the units around a block compares with that of the block.
struct Agreement {
  int judged = 0;
  int agreeing = 0;
  double distance = 0;  // sum over the judged units
};

bool has_compounds(const FrameMotion& frame) {
  return std::any_of(frame.blocks.begin(), frame.blocks.end(),
                     [](const av1::BlockInfo& block) { return block.is_compound(); });
}

void read_frame_values(const FrameMotion& frame, TrustedMotion& motion) {
  motion.decode_index = frame.decode_index;
  motion.display_index = frame.display_index;
  motion.rows = frame.mi_rows;
  motion.cols = frame.mi_cols;
  motion.visible_rows = std::min(frame.mi_rows, (frame.height + 3) / 4);
  motion.visible_cols = std::min(frame.mi_cols, (frame.frame_width + 3) / 4);
  motion.width = static_cast<float>(frame.width);
  motion.height = static_cast<float>(frame.height);
  motion.coded_width = static_cast<float>(frame.frame_width);
  motion.upscale = motion.width / motion.coded_width;
  for (int ref = 0; ref < kNumRefs; ++ref) {
    const int display_index = frame.ref_display_index[ref];
    motion.ref_decode_index[ref] = ref > 0 ? frame.ref_decode_index[ref] : -1;
    motion.ref_interval[ref] =
        display_index >= 0 && frame.display_index >= 0 ? display_index - frame.display_index : 0;
  }
  motion.mi_size.resize(frame.block_index.size());
  for (int unit = 0; unit < frame.num_units(); ++unit) {
    motion.mi_size[unit] = frame.block(unit).mi_size;
  }
  motion.num_lists = has_compounds(frame) ? 2 : 1;
  for (auto& list : motion.used_lists()) list.assign(motion.mi_size.size(), UnitMotion{});
}

// The local warp models of a frame, then its global ones by RefFrame.
void keep_warps(const FrameMotion& frame, TrustedMotion& motion) {
  motion.warps.assign(frame.local_warp_params.begin(), frame.local_warp_params.end());
  motion.warps.insert(motion.warps.end(), frame.gm_params.begin(), frame.gm_params.end());
}

// The index of a displacement's warp among the kept warps; -1 for a translation
std::int32_t kept_warp(const FrameMotion& frame, const Displacement& d) {
  if (d.warp == nullptr) return -1;
  const auto num_local = static_cast<std::ptrdiff_t>(frame.local_warp_params.size());
  const bool global = d.warp == &frame.gm_params[d.ref];
  return static_cast<std::int32_t>(global ? num_local + d.ref
                                          : d.warp - frame.local_warp_params.data());
}

bool is_small_enough(const TrackBuilderOptions& options, int block_area, bool has_residual) {
  if (options.max_block_area && block_area > *options.max_block_area) return false;
  return has_residual || !options.max_uncoded_block_area ||
         block_area <= *options.max_uncoded_block_area;
}

// Whether both ends of a motion keep a distance from the edge of the picture.
bool is_within_border(const TrustedMotion& motion, float border, Point from, Point to) {
  const auto is_in_border = [&](Point p) {
    return p.x < border || p.y < border || p.x > motion.coded_width - border ||
           p.y > motion.height - border;
  };
  return !is_in_border(from) && !is_in_border(to);
}

TimedMotion timed(const TrustedMotion& motion, Point at, const Displacement& d) {
  return {{at.x, at.y, d.dx, d.dy}, motion.ref_interval[d.ref]};
}

// Calls `visit` with units that are spread over the picture.
template <typename Visit>
void visit_spread_units(const TrustedMotion& motion, const Visit& visit) {
  const int num_units = motion.rows * motion.cols;
  const int step = std::max(1, static_cast<int>(std::sqrt(num_units / kSpreadSamples)));
  // Blocks in partial superblocks are excluded, because they are small for lack of space.
  for (int row = step / 2; row < motion.visible_rows / kSuperblock * kSuperblock; row += step) {
    for (int col = step / 2; col < motion.visible_cols / kSuperblock * kSuperblock; col += step) {
      visit(row * motion.cols + col);
    }
  }
}

// Whether the picture shows any detail.
bool shows_detail(const FrameMotion& frame, const TrackBuilderOptions& options,
                  const DisplacementModel& model, const TrustedMotion& motion,
                  const RefDetail& ref_has_detail) {
  int num_units = 0;
  int num_detailed = 0;
  int num_with_residual = 0;
  std::array<int, kNumRefs> num_linked{};
  visit_spread_units(motion, [&](int unit) {
    const int area = motion.block_area(unit);
    const bool has_residual = frame.block(unit).skip == 0;
    const int ref = model.at(unit, 0).ref;
    ++num_units;
    num_detailed +=
        is_small_enough(options, area, has_residual) && (ref != 0 || area < kPlainIntraArea);
    num_with_residual += has_residual;
    ++num_linked[ref];
  });
  if (num_detailed >= kDetail * num_units) return true;
  const auto main_ref = std::ranges::max_element(num_linked) - num_linked.begin();
  return num_with_residual <= kRepeat * num_units && ref_has_detail[main_ref];
}

// The affine motion in the frame's first list. There is none if all blocks are small enough, if
// fewer than half of the sampled units have motion, or without detail: a picture of one colour
// seems to stand still.
AffineMotion common_motion(const FrameMotion& frame, const TrackBuilderOptions& options,
                           const DisplacementModel& model, const TrustedMotion& motion) {
  int num_units = 0;
  int num_large = 0;
  std::vector<TimedMotion> spread;
  visit_spread_units(motion, [&](int unit) {
    const bool has_residual = frame.block(unit).skip == 0;
    ++num_units;
    num_large += !is_small_enough(options, motion.block_area(unit), has_residual);
    const Displacement d = model.at(unit, 0);
    if (d.ref != 0) spread.push_back(timed(motion, motion.unit_centre(unit), d));
  });
  if (num_large == 0 || !motion.has_detail || 2 * std::ssize(spread) < num_units) spread.clear();
  return {spread, motion.coded_width, motion.height};
}

// Reads the displacements of visible units that are trusted by the rules that do not compare a unit
// with its neighbours.
void read_displacements(const FrameMotion& frame, const TrackBuilderOptions& options,
                        const RefDetail& ref_has_detail, TrustedMotion& motion) {
  const DisplacementModel model(frame);
  motion.has_detail = shows_detail(frame, options, model, motion, ref_has_detail);
  const AffineMotion common = common_motion(frame, options, model, motion);
  const auto border = static_cast<float>(options.border.value_or(0));
  for (int row = 0; row < motion.visible_rows; ++row) {
    for (int col = 0; col < motion.visible_cols; ++col) {
      const int unit = row * motion.cols + col;
      const bool small =
          is_small_enough(options, motion.block_area(unit), frame.block(unit).skip == 0);
      const Point centre = motion.unit_centre(unit);
      for (int list = 0; list < motion.num_lists; ++list) {
        const Displacement d = model.at(unit, list);
        if (d.ref == 0 || !options.is_within_reach(motion.ref_interval[d.ref])) continue;
        if (!small && !common.agrees(timed(motion, centre, d))) continue;
        if (border > 0.F &&
            !is_within_border(motion, border, centre, {centre.x + d.dx, centre.y + d.dy})) {
          continue;
        }
        motion.lists[list][unit] = {d.dx, d.dy, kept_warp(frame, d), 0.F,
                                    static_cast<std::int8_t>(d.ref)};
      }
    }
  }
}

// The difference of a unit's motion to that of another unit in px, using the list with the smallest
// difference. Motion into other frames is scaled to the interval. Infinite if nothing can be
// compared.
double disagreement(const TrustedMotion& motion, const UnitMotion& own, int other_unit) {
  const double interval = motion.ref_interval[own.ref];
  double best = std::numeric_limits<double>::infinity();
  for (const auto& list : motion.used_lists()) {
    const UnitMotion& other = list[other_unit];
    if (other.ref == 0) continue;
    double ratio = 1;
    if (motion.ref_decode_index[other.ref] != motion.ref_decode_index[own.ref]) {
      const double other_interval = motion.ref_interval[other.ref];
      if (interval == 0 || other_interval == 0) continue;
      ratio = interval / other_interval;
    }
    best = std::min(
        best, std::max(std::abs(own.dx - ratio * other.dx), std::abs(own.dy - ratio * other.dy)));
  }
  return best;
}

// Compares each unit around the block at (row, col) with the adjacent unit of the block.
Agreement judge_border(const TrustedMotion& motion, std::optional<double> smoothness, int row,
                       int col, int list) {
  Agreement result;
  const auto judge = [&](int inner_row, int inner_col, int outer_row, int outer_col) {
    if (!motion.is_visible(outer_row, outer_col) || inner_row >= motion.visible_rows ||
        inner_col >= motion.visible_cols) {
      return;
    }
    const UnitMotion& own = motion.lists[list][inner_row * motion.cols + inner_col];
    if (own.ref == 0) return;
    const double distance = disagreement(motion, own, outer_row * motion.cols + outer_col);
    if (std::isinf(distance)) return;
    ++result.judged;
    result.distance += distance;
    // Large motion also varies more within the picture.
    const double length = std::sqrt(own.dx * own.dx + own.dy * own.dy);
    if (smoothness && distance <= *smoothness * (1 + length / 8)) ++result.agreeing;
  };
  const int mi_size = motion.mi_size[row * motion.cols + col];
  const int end_row = row + av1::kBlockHeight[mi_size] / 4;
  const int end_col = col + av1::kBlockWidth[mi_size] / 4;
  for (int c = col; c < end_col; ++c) {
    judge(row, c, row - 1, c);
    judge(end_row - 1, c, end_row, c);
  }
  for (int r = row; r < end_row; ++r) {
    judge(r, col, r, col - 1);
    judge(r, end_col - 1, r, end_col);
  }
  return result;
}

// Judges the block whose first unit is at (row, col). At the border of the picture, the first unit
// of a block may be distrusted and others trusted.
Verdict judge_block(const FrameMotion& frame, const TrackBuilderOptions& options,
                    const TrustedMotion& motion, int row, int col, int list) {
  const int unit = row * motion.cols + col;
  const UnitMotion& own = motion.lists[list][unit];
  const Agreement around = judge_border(motion, options.smoothness, row, col, list);
  StepTraits traits;
  traits.block_area = motion.block_area(unit);
  traits.y_mode = frame.block(unit).y_mode;
  traits.has_residual = frame.block(unit).skip == 0;
  traits.warped = own.warp >= 0;
  traits.overlapped = frame.block(unit).motion_mode == av1::OBMC;
  traits.length = std::hypot(own.dx, own.dy);
  if (around.judged > 0) {
    traits.disagreement = static_cast<float>(around.distance / around.judged);
  }
  const float sigma = step_sigma(traits);
  return {sigma * sigma, options.smoothness && 2 * around.agreeing < around.judged};
}

// Determines how much to trust the lists of every block, and removes those that most of the units
// around the block contradict. A block of w x h units lies at a multiple of (w, h), so its size
// determines its origin.
void judge_blocks(const FrameMotion& frame, const TrackBuilderOptions& options,
                  TrustScratch& scratch, TrustedMotion& motion) {
  auto& verdicts = scratch.verdicts;
  for (auto& list : verdicts) list.assign(motion.mi_size.size(), Verdict{});
  for (int row = 0; row < motion.visible_rows; ++row) {
    for (int col = 0; col < motion.visible_cols; ++col) {
      const int unit = row * motion.cols + col;
      const int block_cols = av1::kBlockWidth[motion.mi_size[unit]] / 4;
      const int block_rows = av1::kBlockHeight[motion.mi_size[unit]] / 4;
      const int origin = (row & ~(block_rows - 1)) * motion.cols + (col & ~(block_cols - 1));
      for (int list = 0; list < motion.num_lists; ++list) {
        verdicts[list][unit] = origin != unit ? verdicts[list][origin]
                                              : judge_block(frame, options, motion, row, col, list);
      }
    }
  }
  for (std::size_t unit = 0; unit < motion.mi_size.size(); ++unit) {
    for (int list = 0; list < motion.num_lists; ++list) {
      motion.lists[list][unit].variance = verdicts[list][unit].variance;
      if (verdicts[list][unit].rough) motion.lists[list][unit].ref = 0;
    }
  }
}

}  // namespace

int TrustedMotion::block_area(int unit) const {
  return av1::kBlockWidth[mi_size[unit]] * av1::kBlockHeight[mi_size[unit]];
}

void read_trusted_motion(const FrameMotion& frame, const TrackBuilderOptions& options,
                         const RefDetail& ref_has_detail, TrustScratch& scratch,
                         TrustedMotion& motion) {
  read_frame_values(frame, motion);
  keep_warps(frame, motion);
  read_displacements(frame, options, ref_has_detail, motion);
  judge_blocks(frame, options, scratch, motion);
  const auto limit = [](std::optional<double> value) {
    return static_cast<float>(value.value_or(0));
  };
  if (options.interpolation.value_or(0) > 0)
    interpolate_blocks(limit(options.interpolation), scratch.unfilled, motion);
  if (options.bridge.value_or(0) > 0)
    bridge_blocks(limit(options.bridge), scratch.unfilled, motion);
  motion.num_linked = {};
  for (const auto& list : motion.used_lists()) {
    for (const UnitMotion& unit : list) ++motion.num_linked[unit.ref];
  }
}

}  // namespace colmap_av1::tracks
