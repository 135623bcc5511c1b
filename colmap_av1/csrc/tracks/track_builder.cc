#include "tracks/track_builder.h"

#include <algorithm>
#include <cmath>
#include <cstdlib>
#include <limits>
#include <stdexcept>
#include <utility>

#include "av1/constants.h"
#include "av1/spec_tables.h"
#include "tracks/trust.h"

namespace colmap_av1::tracks {
namespace {

constexpr float kUnit = 4.F;
constexpr int kMaxBridge = 8;  // units to the motion on either side
constexpr std::size_t kMaxDominantSamples = 1024;
constexpr float kNan = std::numeric_limits<float>::quiet_NaN();

int block_area(int mi_size) { return av1::kBlockWidth[mi_size] * av1::kBlockHeight[mi_size]; }

bool has_compounds(const MotionField& field) {
  for (int unit = 0; unit < field.num_units(); ++unit) {
    if (field.ref_frame[2 * unit + 1] > 0) return true;
  }
  return false;
}

}  // namespace

TrackBuilder::TrackBuilder(const TrackBuilderOptions& options)
    : options_(options),
      log_cells_(options.cells / 2),  // of 1, 2 and 4
      half_cell_(kUnit / 2.F / static_cast<float>(options.cells)) {
  const auto is_part = [](int count) { return count == 1 || count == 2 || count == 4; };
  if (!is_part(options.cells) || !is_part(options.seeding) || options.seeding > options.cells) {
    throw std::invalid_argument("cells and seeding are 1, 2 or 4, seeding not above cells");
  }
}

void TrackBuilder::add(const CodedFrame& coded) {
  check_motion_field(coded.field);
  const auto is_index = [](int index) { return index < std::numeric_limits<int>::max(); };
  if (coded.width < 1 || !is_index(coded.display_index) ||
      !std::all_of(coded.ref_display_index, coded.ref_display_index + kNumRefs, is_index)) {
    throw std::invalid_argument("a width or a display_index is out of range");
  }
  if (find_frame(coded.decode_index) != nullptr) {
    throw std::invalid_argument("a decode_index occurs twice");
  }
  if (coded.display_index >= 0) {
    if (coded.display_index <= last_display_ || is_waiting(coded.display_index)) {
      throw std::invalid_argument("the frames are not in bitstream order: a display_index "
                                  "comes twice or too late");
    }
    if (width_ == 0) {
      width_ = coded.width;
      height_ = coded.height;
    }
    num_frames_ = std::max(num_frames_, coded.display_index + 1);
  }
  Frame& frame = read_frame(coded);
  if (frame.display_index < 0) {
    chain_frame(frame);
  } else if (coded.show_frame) {
    // Frames are output in display order: all before this one have been read.
    last_display_ = coded.display_index;
    chain_up_to(frame.display_index);
  }
  release_frames(coded.slot_decode_index);
}

TrackArrays TrackBuilder::finish() {
  chain_up_to(std::numeric_limits<int>::max());
  for (const auto& frame : frames_) release(*frame);
  frames_.clear();
  std::sort(kept_.begin(), kept_.end(),
            [](const Kept& a, const Kept& b) { return a.serial < b.serial; });

  tracks_.clear();
  stretches_.clear();
  idle_frames_.clear();
  TrackArrays out;
  out.num_frames = num_frames_;
  out.width = width_;
  out.height = height_;
  out.offsets.reserve(kept_.size() + 1);
  out.offsets.push_back(0);
  for (const Kept& kept : kept_) out.offsets.push_back(out.offsets.back() + kept.length);
  // One array after the other, the largest first: that takes the least memory.
  const auto sort = [this](auto& values, std::ptrdiff_t width, auto* sorted) {
    sorted->resize(values.size());
    auto end = sorted->begin();
    for (const Kept& kept : kept_) {
      const auto first = values.begin() + width * kept.first;
      end = std::copy(first, first + width * kept.length, end);
    }
    values = {};
  };
  sort(done_.xy, 2, &out.xy);
  sort(done_.frame, 1, &out.frame);
  sort(done_.sigma, 1, &out.sigma);
  *this = TrackBuilder(options_);
  return out;
}

TrackBuilder::Frame* TrackBuilder::find_frame(int decode_index) const {
  for (const auto& frame : frames_) {
    if (frame->decode_index == decode_index) return frame.get();
  }
  return nullptr;
}

bool TrackBuilder::is_waiting(int display_index) const {
  return std::any_of(frames_.begin(), frames_.end(), [display_index](const auto& frame) {
    return !frame->chained && frame->display_index == display_index;
  });
}

// Copies what chaining needs of a coded frame: the displacements that may be trusted.
TrackBuilder::Frame& TrackBuilder::read_frame(const CodedFrame& coded) {
  if (idle_frames_.empty()) idle_frames_.push_back(std::make_unique<Frame>());
  frames_.push_back(std::move(idle_frames_.back()));
  idle_frames_.pop_back();
  Frame& frame = *frames_.back();
  MotionField field = coded.field;
  const int num_units = field.num_units();
  frame.decode_index = coded.decode_index;
  frame.display_index = coded.display_index;
  frame.chained = false;
  frame.rows = field.mi_rows;
  frame.cols = field.mi_cols;
  frame.visible_rows = std::min(field.mi_rows, (field.height + 3) / 4);
  frame.visible_cols = std::min(field.mi_cols, (field.width + 3) / 4);
  frame.cell_rows = options_.cells * frame.rows;
  frame.cell_cols = options_.cells * frame.cols;
  frame.width = static_cast<float>(coded.width);
  frame.height = static_cast<float>(coded.height);
  frame.coded_width = static_cast<float>(field.width);
  frame.upscale = frame.width / frame.coded_width;
  for (int ref = 0; ref < kNumRefs; ++ref) {
    const int display_index = coded.ref_display_index[ref];
    frame.ref_decode_index[ref] = ref > 0 ? coded.ref_decode_index[ref] : -1;
    frame.ref_interval[ref] = display_index >= 0 && coded.display_index >= 0
                                  ? display_index - coded.display_index
                                  : 0;
  }
  frame.warps.assign(field.local_warp_params, field.local_warp_params + 6 * field.num_local_warps);
  frame.warps.insert(frame.warps.end(), field.gm_params, field.gm_params + 6 * (kNumRefs - 1));
  field.local_warp_params = frame.warps.data();
  field.gm_params = frame.warps.data() + 6 * field.num_local_warps;

  const DisplacementModel model(field);
  const float border = static_cast<float>(std::max(0.0, options_.border));
  const auto is_in_border = [&](float x, float y) {
    return x < border || y < border || x > frame.coded_width - border || y > frame.height - border;
  };
  frame.mi_size.assign(field.mi_size, field.mi_size + num_units);
  frame.num_lists = has_compounds(field) ? 2 : 1;
  for (auto& list : frame.lists()) list.assign(frame.mi_size.size(), UnitMotion{});
  for (int row = 0; row < frame.visible_rows; ++row) {
    for (int col = 0; col < frame.visible_cols; ++col) {
      const int unit = row * field.mi_cols + col;
      const int area = block_area(field.mi_size[unit]);
      if (options_.max_block_area >= 0 && area > options_.max_block_area) continue;
      if (options_.max_uncoded_block_area >= 0 && coded.skip[unit] != 0 &&
          area > options_.max_uncoded_block_area) {
        continue;
      }
      for (int list = 0; list < frame.num_lists; ++list) {
        const Displacement d = model.at(unit, list);
        if (d.ref == 0 || !is_within_reach(frame.ref_interval[d.ref])) continue;
        const float x = kUnit * static_cast<float>(col) + kUnit / 2.F;
        const float y = kUnit * static_cast<float>(row) + kUnit / 2.F;
        if (border > 0 && (is_in_border(x, y) || is_in_border(x + d.dx, y + d.dy))) continue;
        const int32_t warp =
            d.warp == nullptr ? -1 : static_cast<int32_t>(d.warp - frame.warps.data());
        frame.motion[list][unit] = {d.dx, d.dy, warp, 0.F, static_cast<int8_t>(d.ref)};
      }
    }
  }
  judge_blocks(frame, coded);
  if (options_.interpolation > 0) interpolate(frame);
  if (options_.bridge > 0) bridge(frame);
  frame.num_linked = {};
  for (const auto& list : frame.lists()) {
    for (const UnitMotion& motion : list) ++frame.num_linked[motion.ref];
  }
  return frame;
}

// Says how far to trust the lists of every block, and takes out those that most of the units
// around it contradict. A block of w x h units lies at a multiple of (w, h), so its origin follows
// from its size.
void TrackBuilder::judge_blocks(Frame& frame, const CodedFrame& coded) {
  for (auto& list : verdicts_) list.assign(frame.mi_size.size(), Verdict{});
  for (int row = 0; row < frame.visible_rows; ++row) {
    for (int col = 0; col < frame.visible_cols; ++col) {
      const int unit = row * frame.cols + col;
      const int block_cols = av1::kBlockWidth[frame.mi_size[unit]] / 4;
      const int block_rows = av1::kBlockHeight[frame.mi_size[unit]] / 4;
      const int origin = (row & ~(block_rows - 1)) * frame.cols + (col & ~(block_cols - 1));
      for (int list = 0; list < frame.num_lists; ++list) {
        if (origin != unit) {
          verdicts_[list][unit] = verdicts_[list][origin];
          continue;
        }
        // Of a block at the picture's border, other units may be trusted than the origin.
        const UnitMotion& motion = frame.motion[list][unit];
        const Agreement around = judge_border(frame, row, col, list);
        StepTraits traits;
        traits.block_area = block_area(frame.mi_size[unit]);
        traits.y_mode = coded.field.y_mode[unit];
        traits.coded = coded.skip[unit] == 0;
        traits.warped = motion.warp >= 0;
        traits.overlapped = coded.field.motion_mode[unit] == av1::OBMC;
        traits.length = std::hypot(motion.dx, motion.dy);
        if (around.judged > 0) {
          traits.disagreement = static_cast<float>(around.distance / around.judged);
        }
        const float sigma = step_sigma(traits);
        verdicts_[list][unit] = {sigma * sigma, options_.smoothness >= 0 &&
                                                    2 * around.agreeing < around.judged};
      }
    }
  }
  for (std::size_t unit = 0; unit < frame.mi_size.size(); ++unit) {
    for (int list = 0; list < frame.num_lists; ++list) {
      frame.motion[list][unit].variance = verdicts_[list][unit].variance;
      if (verdicts_[list][unit].rough) frame.motion[list][unit].ref = 0;
    }
  }
}

// A block has one vector, the best for all of it; what it shows moves smoothly. Every unit is given
// the vector between the centres of its block and of the blocks beside it that move alike, across
// and down. A warp already says how its block moves from place to place; at the border to one, its
// unit's displacement counts where that unit lies.
void TrackBuilder::interpolate(Frame& frame) {
  const auto limit = static_cast<float>(options_.interpolation);
  for (auto& list : frame.lists()) {
    block_motion_.assign(list.begin(), list.end());
    for (int row = 0; row < frame.visible_rows; ++row) {
      for (int col = 0; col < frame.visible_cols; ++col) {
        const int unit = row * frame.cols + col;
        const UnitMotion& own = block_motion_[unit];
        if (own.ref == 0 || own.warp >= 0) continue;
        const int mi_size = frame.mi_size[unit];
        // Along one axis: from a unit at `place` to the block before or behind.
        const auto add = [&](int place, int units, int end, int stride, bool across) {
          const int first = place & ~(units - 1);
          const int twice_offset = 2 * (place - first) + 1 - units;  // from the centre, in units
          const int neighbour = twice_offset < 0 ? first - 1 : first + units;
          if (twice_offset == 0 || neighbour < 0 || neighbour >= end) return;
          const int other_unit = unit + (neighbour - place) * stride;
          const UnitMotion& other = block_motion_[other_unit];
          const float dx = other.dx - own.dx;
          const float dy = other.dy - own.dy;
          if (other.ref != own.ref || std::max(std::abs(dx), std::abs(dy)) >= limit) return;
          const int other_size = frame.mi_size[other_unit];
          const int other_units =
              (across ? av1::kBlockWidth[other_size] : av1::kBlockHeight[other_size]) / 4;
          const int twice_distance = units + (other.warp >= 0 ? 1 : other_units);
          const float share =
              static_cast<float>(std::abs(twice_offset)) / static_cast<float>(twice_distance);
          list[unit].dx += share * dx;
          list[unit].dy += share * dy;
        };
        add(col, av1::kBlockWidth[mi_size] / 4, frame.visible_cols, 1, true);
        add(row, av1::kBlockHeight[mi_size] / 4, frame.visible_rows, frame.cols, false);
      }
    }
  }
}

// Units of a block without motion that may be trusted, such as an intra one, move as what lies on
// either side where that moves alike, across and down: each is given the motion between.
void TrackBuilder::bridge(Frame& frame) {
  auto& list = frame.motion[0];
  block_motion_.assign(list.begin(), list.end());
  const auto nearest = [&](int row, int col, int row_step, int col_step, int* distance) {
    for (*distance = 1; *distance <= kMaxBridge; ++*distance) {
      row += row_step;
      col += col_step;
      if (row < 0 || row >= frame.visible_rows || col < 0 || col >= frame.visible_cols) break;
      const UnitMotion& motion = block_motion_[row * frame.cols + col];
      if (motion.ref != 0) return &motion;
    }
    return static_cast<const UnitMotion*>(nullptr);
  };
  for (int row = 0; row < frame.visible_rows; ++row) {
    for (int col = 0; col < frame.visible_cols; ++col) {
      const int unit = row * frame.cols + col;
      if (frame.moves(unit)) continue;
      UnitMotion between;
      float total = 0.F;
      bool agrees = true;
      for (const bool across : {true, false}) {
        int before = 0;
        int behind = 0;
        const UnitMotion* a = nearest(row, col, across ? 0 : -1, across ? -1 : 0, &before);
        const UnitMotion* b = nearest(row, col, across ? 0 : 1, across ? 1 : 0, &behind);
        if (a == nullptr || b == nullptr || a->ref != b->ref) continue;
        if (between.ref != 0 && a->ref != between.ref) continue;
        if (!moves_alike(*a, *b)) {
          agrees = false;
          continue;
        }
        const float share = static_cast<float>(before) / static_cast<float>(before + behind);
        const float weight = 1.F / static_cast<float>(before + behind);
        const float gap = distance({a->dx, a->dy}, {b->dx, b->dy});
        between.dx += weight * (a->dx + share * (b->dx - a->dx));
        between.dy += weight * (a->dy + share * (b->dy - a->dy));
        between.variance += weight * (std::max(a->variance, b->variance) + gap * gap);
        between.ref = a->ref;
        total += weight;
      }
      if (between.ref == 0 || !agrees) continue;
      between.dx /= total;
      between.dy /= total;
      between.variance /= total;
      list[unit] = between;
    }
  }
}

bool TrackBuilder::moves_alike(const UnitMotion& a, const UnitMotion& b) const {
  return distance({a.dx, a.dy}, {b.dx, b.dy}) < static_cast<float>(options_.bridge);
}

TrackBuilder::Agreement TrackBuilder::judge_border(const Frame& frame, int row, int col,
                                                   int list) const {
  Agreement result;
  // Each unit outside is held against the unit of the block that it touches.
  const auto judge = [&](int inner_row, int inner_col, int outer_row, int outer_col) {
    if (outer_row < 0 || outer_row >= frame.visible_rows || outer_col < 0 ||
        outer_col >= frame.visible_cols || inner_row >= frame.visible_rows ||
        inner_col >= frame.visible_cols) {
      return;
    }
    const UnitMotion& own = frame.motion[list][inner_row * frame.cols + inner_col];
    if (own.ref == 0) return;
    const double interval = frame.ref_interval[own.ref];
    double best = std::numeric_limits<double>::infinity();
    for (const auto& motion : frame.lists()) {
      const UnitMotion& other = motion[outer_row * frame.cols + outer_col];
      if (other.ref == 0) continue;
      double ratio = 1;
      if (frame.ref_decode_index[other.ref] != frame.ref_decode_index[own.ref]) {
        const double other_interval = frame.ref_interval[other.ref];
        if (interval == 0 || other_interval == 0) continue;
        ratio = interval / other_interval;
      }
      best = std::min(best, std::max(std::abs(own.dx - ratio * other.dx),
                                     std::abs(own.dy - ratio * other.dy)));
    }
    if (std::isinf(best)) return;
    ++result.judged;
    result.distance += best;
    // Motion that is large changes much from place to place.
    const double length = std::sqrt(own.dx * own.dx + own.dy * own.dy);
    const double tolerance = options_.smoothness * (1 + length / 8);
    if (best <= tolerance) ++result.agreeing;
  };
  const int mi_size = frame.mi_size[row * frame.cols + col];
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

void TrackBuilder::chain_up_to(int display_index) {
  while (true) {
    Frame* next = nullptr;
    for (const auto& frame : frames_) {
      if (!frame->chained && frame->display_index <= display_index &&
          (next == nullptr || frame->display_index < next->display_index)) {
        next = frame.get();
      }
    }
    if (next == nullptr) return;
    chain_frame(*next);
  }
}

void TrackBuilder::chain_frame(Frame& frame) {
  current_ = &frame;
  frame.chained = true;
  frame.cells.assign(static_cast<std::size_t>(frame.cell_rows) * frame.cell_cols, Cell{});
  frame.first_serial = next_serial_;
  next_serial_ += static_cast<int64_t>(frame.cells.size());
  if (uses_cosine()) frame.velocity.assign(frame.cells.size(), Point{kNan, kNan});
  find_links();
  note_open_units();
  for (Link& link : links_) {
    if (uses_cosine() && options_.cosine_relative_to_dominant) fit_dominant(link);
    if (link.forward) {
      for (int list = 0; list < link.other->num_lists; ++list) chain_forward(link, list);
      continue;
    }
    for (int list = 0; list < frame.num_lists; ++list) chain_backward(link, list, Reach::kOwn);
    if (options_.bridge <= 0) continue;
    for (int list = 0; list < frame.num_lists; ++list) chain_backward(link, list, Reach::kBeside);
  }
  seed();
  if (frame.display_index >= 0) observe();
  ++frames_chained_;
}

// Nearest in display first; a frame that is never shown has no place in time and comes
// last.
void TrackBuilder::find_links() {
  links_.clear();
  const auto add_link = [this](const Frame& from, const Frame& to, Frame& other) {
    Link link;
    link.other = &other;
    link.forward = &from == &other;
    for (int ref = 1; ref < kNumRefs; ++ref) {
      link.refs[ref] = from.ref_decode_index[ref] == to.decode_index;
    }
    if (other.display_index >= 0 && current_->display_index >= 0) {
      link.interval = other.display_index - current_->display_index;
    }
    link.distance =
        link.interval != 0 ? std::abs(link.interval) : std::numeric_limits<int>::max();
    link.from_picture_x = current_->coded_width / other.width;
    link.from_picture_y = current_->height / other.height;
    const float cell = 2.F * half_cell_;
    link.to_cells_x = 1.F / (cell * other.upscale * link.from_picture_x);
    link.to_cells_y = 1.F / (cell * link.from_picture_y);
    link.picture_x = current_->width / other.width;
    link.picture_y = current_->height / other.height;
    if (link.interval != 0) {
      // A backward displacement spans the interval, a forward one its negative.
      const double interval = link.forward ? -link.interval : link.interval;
      link.to_velocity_x = current_->width / from.coded_width / interval;
      link.to_velocity_y = current_->height / from.height / interval;
    }
    links_.push_back(link);
  };
  for (const auto& other : frames_) {
    if (!other->chained || other.get() == current_) continue;
    if (links(*current_, *other)) add_link(*current_, *other, *other);
    if (links(*other, *current_)) add_link(*other, *current_, *other);
  }
  std::stable_sort(links_.begin(), links_.end(),
                   [](const Link& a, const Link& b) { return a.distance < b.distance; });
}

bool TrackBuilder::is_within_reach(int interval) const {
  return options_.max_interval < 0 || std::abs(interval) <= options_.max_interval;
}

bool TrackBuilder::links(const Frame& from, const Frame& to) const {
  for (int ref = 1; ref < kNumRefs; ++ref) {
    if (from.ref_decode_index[ref] == to.decode_index) {
      return is_within_reach(from.ref_interval[ref]);
    }
  }
  return false;
}

void TrackBuilder::fit_dominant(Link& link) {
  const Frame& frame = link.forward ? *link.other : *current_;
  std::size_t count = 0;
  for (int ref = 1; ref < kNumRefs; ++ref) count += link.refs[ref] ? frame.num_linked[ref] : 0;
  const std::size_t stride = count / kMaxDominantSamples + 1;
  samples_.clear();
  std::size_t index = 0;
  for (const auto& motion : frame.lists()) {
    for (std::size_t unit = 0; unit < motion.size(); ++unit) {
      if (!link.refs[motion[unit].ref] || index++ % stride != 0) continue;
      const Point centre = unit_centre(frame, static_cast<int>(unit));
      samples_.push_back({centre.x, centre.y, motion[unit].dx, motion[unit].dy});
    }
  }
  link.dominant = fit_dominant_motion(samples_, frame.coded_width, frame.height, scratch_);
}

// The units that may move a track into the current frame.
void TrackBuilder::note_open_units() {
  open_units_.clear();
  if (std::all_of(links_.begin(), links_.end(), [](const Link& link) { return link.forward; })) {
    return;
  }
  for (int row = 0; row < current_->visible_rows; ++row) {
    for (int col = 0; col < current_->visible_cols; ++col) {
      const int unit = row * current_->cols + col;
      if (current_->moves(unit)) open_units_.push_back({row, col});
    }
  }
}

// Whether a cell of the current frame's unit holds no track yet.
bool TrackBuilder::is_open(OpenUnit unit) const {
  const int size = options_.cells;
  const Cell* first = current_->cells.data() +
                      static_cast<std::ptrdiff_t>(size) * unit.row * current_->cell_cols +
                      static_cast<std::ptrdiff_t>(size) * unit.col;
  for (int row = 0; row < size; ++row, first += current_->cell_cols) {
    for (int col = 0; col < size; ++col) {
      if (first[col].track < 0) return true;
    }
  }
  return false;
}

// By the current frame's displacements: every free cell asks for the longest track that it
// finds, every track goes to the cell that puts it nearest to its centre (a stable
// matching, so the order of cells does not matter).
void TrackBuilder::chain_backward(const Link& link, int list, Reach reach) {
  const auto& motion = current_->motion[list];
  claims_.resize(link.other->cells.size());
  // A cell as large as its unit is searched in no more time than the unit is judged.
  const bool judges_units = options_.cells > 1;
  bool noted = false;
  std::size_t num_open = 0;
  for (std::size_t i = 0; i < open_units_.size(); ++i) {
    const OpenUnit open = open_units_[i];
    if (!is_open(open)) continue;
    open_units_[num_open++] = open;
    const int unit = open.row * current_->cols + open.col;
    if (!link.refs[motion[unit].ref]) continue;
    if (judges_units) {
      if (!noted) note_unplaced_units(*link.other);
      noted = true;
      if (!may_find_track(link, unit, motion[unit], reach)) continue;
    }
    for (int part = 0; part < options_.cells * options_.cells; ++part) {
      const int row = options_.cells * open.row + (part >> log_cells_);
      const int col = options_.cells * open.col + (part & (options_.cells - 1));
      int cell = row * current_->cell_cols + col;
      if (current_->cells[cell].track >= 0) continue;
      int unit_of_cell = unit;
      Point centre = cell_centre(row, col);
      while (true) {
        int best = -1;
        Claim claim;
        if (reach == Reach::kOwn) {
          find_track(link, cell, centre, motion[unit_of_cell], &best, &claim);
        } else {
          find_track_beside(link, list, cell, centre, &best, &claim);
        }
        if (best < 0) break;
        if (claims_[best].cell < 0) claimed_.push_back(best);
        // The cell that held the claim until now looks for another track.
        cell = std::exchange(claims_[best], claim).cell;
        if (cell < 0) break;
        unit_of_cell = unit_of(*current_, cell);
        centre = cell_centre(cell / current_->cell_cols, cell % current_->cell_cols);
      }
    }
  }
  open_units_.resize(num_open);
  for (const int32_t cell : claimed_) {
    const Claim claim = std::exchange(claims_[cell], Claim{});
    carry_on(*link.other, cell, claim.cell, claim);
  }
  claimed_.clear();
}

// The units of a frame with tracks that have no place in the current frame yet.
void TrackBuilder::note_unplaced_units(const Frame& other) {
  unplaced_units_.assign(other.mi_size.size(), 0);
  const Cell* cell = other.cells.data();
  for (int row = 0; row < other.cell_rows; ++row) {
    uint8_t* unit =
        unplaced_units_.data() + static_cast<std::ptrdiff_t>(row >> log_cells_) * other.cols;
    for (int col = 0; col < other.cols; ++col, ++unit) {
      for (const Cell* end = cell + options_.cells; cell < end; ++cell) {
        if (is_unplaced(*cell)) *unit = 1;
      }
    }
  }
}

// Whether the cells of a unit can find any track, to search them only then.
bool TrackBuilder::may_find_track(const Link& link, int unit, const UnitMotion& motion,
                                  Reach reach) const {
  // A valid warp stretches a unit by less than half its size; beside it motion is alike.
  float pixels = 0.75F * kUnit;
  if (reach == Reach::kBeside) {
    if (options_.bridge > kUnit) return true;
    pixels += static_cast<float>(options_.bridge);
  }
  const Frame& other = *link.other;
  const Point centre = unit_centre(*current_, unit);
  const Window window = around(link, {centre.x + motion.dx, centre.y + motion.dy}, pixels);
  if (window.bottom < window.top || window.right < window.left) return false;
  for (int row = window.top >> log_cells_; row <= window.bottom >> log_cells_; ++row) {
    for (int col = window.left >> log_cells_; col <= window.right >> log_cells_; ++col) {
      if (unplaced_units_[row * other.cols + col] != 0) return true;
    }
  }
  return false;
}

// The same by the displacements of the units beside the cell's: where these point apart, tracks lie
// in the gap that their blocks leave.
void TrackBuilder::find_track_beside(const Link& link, int list, int cell, Point centre,
                                     int* best, Claim* best_claim) const {
  const int unit = unit_of(*current_, cell);
  const int row = unit / current_->cols;
  const int col = unit % current_->cols;
  const auto& motion = current_->motion[list];
  const UnitMotion& own = motion[unit];
  for (int r = std::max(0, row - 1); r <= std::min(current_->visible_rows - 1, row + 1); ++r) {
    for (int c = std::max(0, col - 1); c <= std::min(current_->visible_cols - 1, col + 1); ++c) {
      const UnitMotion& other = motion[r * current_->cols + c];
      if (!link.refs[other.ref] || !moves_alike(other, own)) continue;
      // The cell has looked there already.
      if (other.dx == own.dx && other.dy == own.dy && other.warp == own.warp) continue;
      find_track(link, cell, centre, other, best, best_claim);
    }
  }
}

// By the other frame's displacements: every track moves with the unit it lies in, and a
// free cell takes the longest one that lands in it.
void TrackBuilder::chain_forward(const Link& link, int list) {
  Frame& other = *link.other;
  const auto& motion = other.motion[list];
  const float scale_x = current_->coded_width / other.coded_width;
  const float scale_y = current_->height / other.height;
  claims_.resize(current_->cells.size());
  for (int row = 0; row < options_.cells * other.visible_rows; ++row) {
    for (int col = 0; col < options_.cells * other.visible_cols; ++col) {
      const int index = row * other.cell_cols + col;
      const int unit = (row >> log_cells_) * other.cols + (col >> log_cells_);
      const Cell& cell = other.cells[index];
      if (!link.refs[motion[unit].ref] || !is_unplaced(cell)) continue;
      const Point from{cell.position.x / other.upscale, cell.position.y};
      const Point moved = move(other, motion[unit], from);
      Claim claim;
      claim.cell = index;
      claim.position = {moved.x * scale_x, moved.y * scale_y};
      claim.variance = cell.variance + motion[unit].variance;
      if (!is_in_picture(claim.position)) continue;
      const float size = 2.F * half_cell_;
      const int target_row = static_cast<int>(claim.position.y / size);
      const int target_col = static_cast<int>(claim.position.x / size);
      const int target = target_row * current_->cell_cols + target_col;
      if (current_->cells[target].track >= 0) continue;
      claim.cost = distance(claim.position, cell_centre(target_row, target_col));
      const Claim& holder = claims_[target];
      if ((holder.cell < 0 || is_preferred(other, index, claim, holder.cell, holder)) &&
          passes_cosine(link, index, from, moved, &claim)) {
        if (holder.cell < 0) claimed_.push_back(target);
        claims_[target] = claim;
      }
    }
  }
  for (const int32_t cell : claimed_) {
    const Claim claim = std::exchange(claims_[cell], Claim{});
    carry_on(other, claim.cell, cell, claim);
  }
  claimed_.clear();
}

// The longest track that `cell` has a better claim on than the cell that holds it, by the motion
// of a unit; what `best` holds already is kept where it is longer.
void TrackBuilder::find_track(const Link& link, int cell, Point centre, const UnitMotion& motion,
                              int* best, Claim* best_claim) const {
  const Frame& other = *link.other;
  // A valid warp stretches a unit by less than half its size, about the unit's centre.
  const float reach = motion.warp < 0 ? half_cell_ : half_cell_ + kUnit / 4.F;
  const Window window = around(link, {centre.x + motion.dx, centre.y + motion.dy}, reach);
  for (int row = window.top; row <= window.bottom; ++row) {
    for (int col = window.left; col <= window.right; ++col) {
      const int index = row * other.cell_cols + col;
      const Cell& found = other.cells[index];
      if (found.track == kNone) continue;
      const Point target{found.position.x * link.from_picture_x,
                         found.position.y * link.from_picture_y};
      Point position;
      if (!move_back(*current_, motion, target, &position) || !is_in_cell(position, centre)) {
        continue;
      }
      Claim claim;
      claim.position = position;
      claim.cell = cell;
      claim.cost = distance(claim.position, centre);
      claim.variance = found.variance + motion.variance;
      if ((*best >= 0 && !is_preferred(other, index, claim, *best, *best_claim)) ||
          !is_in_picture(claim.position) || !is_better(claim, claims_[index]) ||
          !is_unplaced(found) ||
          !passes_cosine(link, index, claim.position, target, &claim)) {
        continue;
      }
      *best = index;
      *best_claim = claim;
    }
  }
}

// Of two tracks that want one cell the longer goes on: another one can start at any time.
bool TrackBuilder::is_preferred(const Frame& frame, int cell, const Claim& claim, int other_cell,
                                const Claim& other_claim) const {
  const int32_t own_length = length(frame, frame.cells[cell]);
  const int32_t other_length = length(frame, frame.cells[other_cell]);
  return own_length != other_length ? own_length > other_length : claim.cost < other_claim.cost;
}

// Whether a cell holds a track that has no place in the current frame yet.
bool TrackBuilder::is_unplaced(const Cell& cell) const {
  return cell.track == kSeed ||
         (cell.track != kNone && tracks_[cell.track].last_seen != frames_chained_);
}

// Shown frames that have seen a cell's track.
int32_t TrackBuilder::length(const Frame& frame, const Cell& cell) const {
  if (cell.track == kSeed) return frame.display_index >= 0 ? 1 : 0;
  return tracks_[cell.track].length;
}

// The vectors of small blocks are the better ones.
bool TrackBuilder::is_better(const Claim& claim, const Claim& holder) const {
  if (holder.cell < 0) return true;
  if (claim.cost != holder.cost) return claim.cost < holder.cost;
  const int area = block_area(current_->mi_size[unit_of(*current_, claim.cell)]);
  const int holder_area = block_area(current_->mi_size[unit_of(*current_, holder.cell)]);
  return area != holder_area ? area < holder_area : claim.cell < holder.cell;
}

float TrackBuilder::distance(Point a, Point b) {
  return std::max(std::abs(a.x - b.x), std::abs(a.y - b.y));
}

// Space-time cosine (the angular error of Barron, Fleet and Beauchemin, IJCV 1994)
// between the motion of this step, `from` to `moved` in the frame whose displacement it
// is, and the one predicted from the step before: the same motion relative to the
// dominant one. Sets the claim's relative velocity.
bool TrackBuilder::passes_cosine(const Link& link, int other_cell, Point from, Point moved,
                                 Claim* claim) const {
  if (!uses_cosine()) return true;
  // Velocities are kept in pixels of the picture they belong to.
  const Point stored = link.other->velocity[other_cell];
  const Point previous{stored.x * link.picture_x, stored.y * link.picture_y};
  claim->velocity = previous;
  const bool relative = options_.cosine_relative_to_dominant;
  if (link.interval == 0 || (relative && !link.dominant.valid)) return true;

  const double vx = (moved.x - from.x) * link.to_velocity_x;
  const double vy = (moved.y - from.y) * link.to_velocity_y;
  const double dominant_x = relative ? link.dominant.dx(from.x, from.y) * link.to_velocity_x : 0;
  const double dominant_y = relative ? link.dominant.dy(from.x, from.y) * link.to_velocity_y : 0;
  claim->velocity = {static_cast<float>(vx - dominant_x), static_cast<float>(vy - dominant_y)};
  if (std::isnan(previous.x)) return true;
  const double px = previous.x + dominant_x;
  const double py = previous.y + dominant_y;
  const double s2 = options_.cosine_scale * options_.cosine_scale;
  const double norm = std::sqrt((vx * vx + vy * vy + s2) * (px * px + py * py + s2));
  return vx * px + vy * py + s2 >= options_.cosine * norm;
}

// Gives the track of another frame's cell its place in a cell of the current frame.
void TrackBuilder::carry_on(Frame& other, int other_cell, int cell, const Claim& claim) {
  int32_t track = other.cells[other_cell].track;
  if (track == kSeed) track = start_track(other, other_cell);
  current_->cells[cell] = {track,
                           {claim.position.x * current_->upscale, claim.position.y},
                           claim.variance};
  if (uses_cosine()) current_->velocity[cell] = claim.velocity;
  tracks_[track].last_seen = frames_chained_;
  ++tracks_[track].frames;
}

// Makes a track of a seed.
int32_t TrackBuilder::start_track(Frame& frame, int cell) {
  auto index = static_cast<int32_t>(tracks_.size());
  if (free_tracks_.empty()) {
    tracks_.emplace_back();
    serials_.emplace_back();
  } else {
    index = free_tracks_.back();
    free_tracks_.pop_back();
    tracks_[index] = Track{};
  }
  serials_[index] = frame.first_serial + cell;
  Track& track = tracks_[index];
  track.frames = 1;
  frame.cells[cell].track = index;
  if (frame.display_index >= 0) observe(track, frame, frame.cells[cell]);
  return index;
}

// In the centre of every square of `seeding` x `seeding` cells that holds no track.
void TrackBuilder::seed() {
  const int size = options_.seeding;
  const float half = half_cell_ * static_cast<float>(size);
  const auto is_empty = [&](int row, int col) {
    for (int r = row; r < row + size; ++r) {
      for (int c = col; c < col + size; ++c) {
        if (current_->cells[r * current_->cell_cols + c].track != kNone) return false;
      }
    }
    return true;
  };
  for (int row = 0; row < options_.cells * current_->visible_rows; row += size) {
    for (int col = 0; col < options_.cells * current_->visible_cols; col += size) {
      if (!is_empty(row, col)) continue;
      const Point centre{2.F * half_cell_ * static_cast<float>(col) + half,
                         2.F * half_cell_ * static_cast<float>(row) + half};
      if (!is_in_picture(centre)) continue;
      const int cell = (row + size / 2) * current_->cell_cols + col + size / 2;
      current_->cells[cell] = {kSeed, {centre.x * current_->upscale, centre.y}, 0.F};
    }
  }
}

void TrackBuilder::observe() {
  for (const Cell& cell : current_->cells) {
    if (cell.track >= 0) observe(tracks_[cell.track], *current_, cell);
  }
}

void TrackBuilder::observe(Track& track, const Frame& frame, const Cell& cell) {
  const float scale_x = static_cast<float>(width_) / frame.width;
  const float scale_y = static_cast<float>(height_) / frame.height;
  const int place = track.length % kStretch;
  if (place == 0) start_stretch(track);
  stretches_[track.last_stretch].observations[place] = {
      frame.display_index,
      {cell.position.x * scale_x, cell.position.y * scale_y},
      std::sqrt(cell.variance) * scale_y};
  ++track.length;
}

void TrackBuilder::start_stretch(Track& track) {
  auto index = static_cast<int32_t>(previous_stretch_.size());
  if (!free_stretches_.empty()) {
    index = free_stretches_.back();
    free_stretches_.pop_back();
  } else if (stretches_.size() < std::numeric_limits<int32_t>::max()) {
    stretches_.emplace_back();
    previous_stretch_.push_back(-1);
  } else {
    throw std::length_error("too many observations at a time: cut the video");
  }
  previous_stretch_[index] = track.last_stretch;
  track.last_stretch = index;
}

// Lets go of the frames that no frame to come can be linked to.
void TrackBuilder::release_frames(const int32_t* slots) {
  const auto is_needed = [&](const Frame& frame) {
    if (!frame.chained) return true;
    if (std::find(slots, slots + kNumRefs, frame.decode_index) != slots + kNumRefs) return true;
    return std::any_of(frames_.begin(), frames_.end(), [&](const auto& other) {
      return !other->chained && (links(*other, frame) || links(frame, *other));
    });
  };
  for (std::size_t i = 0; i < frames_.size();) {
    if (is_needed(*frames_[i])) {
      ++i;
      continue;
    }
    release(*frames_[i]);
    idle_frames_.push_back(std::move(frames_[i]));
    frames_.erase(frames_.begin() + static_cast<std::ptrdiff_t>(i));
  }
}

// A track that no frame holds any more is over: kept, or its memory used again.
void TrackBuilder::release(Frame& frame) {
  for (std::size_t i = 0; i < frame.cells.size(); ++i) {
    const Cell& cell = frame.cells[i];
    if (cell.track == kSeed && length(frame, cell) >= options_.min_length) {
      start_track(frame, static_cast<int>(i));
    }
    if (cell.track < 0) continue;
    Track& track = tracks_[cell.track];
    if (--track.frames > 0) continue;
    free_tracks_.push_back(cell.track);
    if (track.length >= options_.min_length) keep(cell.track);
    for (int32_t s = track.last_stretch; s >= 0; s = previous_stretch_[s]) {
      free_stretches_.push_back(s);
    }
  }
}

void TrackBuilder::keep(int32_t index) {
  const Track& track = tracks_[index];
  const auto first = static_cast<std::ptrdiff_t>(done_.frame.size());
  kept_.push_back({serials_[index], first, track.length});
  const std::size_t size = done_.frame.size() + static_cast<std::size_t>(track.length);
  done_.frame.resize(size);
  done_.xy.resize(2 * size);
  done_.sigma.resize(size);
  auto frame = done_.frame.end();
  auto xy = done_.xy.end();
  auto sigma = done_.sigma.end();
  int32_t stretch = track.last_stretch;
  for (int i = track.length - 1; i >= 0; --i) {
    const Observation& observation = stretches_[stretch].observations[i % kStretch];
    *--frame = observation.frame;
    *--xy = observation.position.y;
    *--xy = observation.position.x;
    *--sigma = observation.sigma;
    if (i % kStretch == 0) stretch = previous_stretch_[stretch];
  }
}

// The other frame's cells within reach of a position in coded pixels of the current one, the reach
// itself left out on the right and below.
TrackBuilder::Window TrackBuilder::around(const Link& link, Point position, float reach) {
  // Far outside there are no cells; the clamp keeps the cast defined.
  const auto first = [](float cell, int count) {
    return static_cast<int>(std::clamp(cell, 0.F, static_cast<float>(count)));
  };
  const auto last = [](float cell, int count) {
    const float clamped = std::clamp(cell, 0.F, static_cast<float>(count));
    const int floor = static_cast<int>(clamped);
    return (static_cast<float>(floor) == clamped ? floor : floor + 1) - 1;
  };
  const Frame& other = *link.other;
  return {first((position.y - reach) * link.to_cells_y, other.cell_rows),
          last((position.y + reach) * link.to_cells_y, other.cell_rows),
          first((position.x - reach) * link.to_cells_x, other.cell_cols),
          last((position.x + reach) * link.to_cells_x, other.cell_cols)};
}

int TrackBuilder::unit_of(const Frame& frame, int cell) const {
  if (options_.cells == 1) return cell;
  const int row = cell / frame.cell_cols;
  const int col = cell - row * frame.cell_cols;
  return (row >> log_cells_) * frame.cols + (col >> log_cells_);
}

TrackBuilder::Point TrackBuilder::unit_centre(const Frame& frame, int unit) {
  return {kUnit * (static_cast<float>(unit % frame.cols) + 0.5F),
          kUnit * (static_cast<float>(unit / frame.cols) + 0.5F)};
}

TrackBuilder::Point TrackBuilder::cell_centre(int row, int col) const {
  return {half_cell_ * static_cast<float>(2 * col + 1),
          half_cell_ * static_cast<float>(2 * row + 1)};
}

// Half-open, so that touching cells share no position.
bool TrackBuilder::is_in_cell(Point position, Point centre) const {
  return position.x >= centre.x - half_cell_ && position.x < centre.x + half_cell_ &&
         position.y >= centre.y - half_cell_ && position.y < centre.y + half_cell_;
}

bool TrackBuilder::is_in_picture(Point position) const {
  return position.x >= 0.F && position.y >= 0.F && position.x < current_->coded_width &&
         position.y < current_->height;
}

TrackBuilder::Point TrackBuilder::move(const Frame& frame, const UnitMotion& motion,
                                       Point position) {
  if (motion.warp < 0) return {position.x + motion.dx, position.y + motion.dy};
  double x = 0;
  double y = 0;
  apply_warp(frame.warps.data() + motion.warp, position.x, position.y, &x, &y);
  return {static_cast<float>(x), static_cast<float>(y)};
}

// The position that `move` takes to `target`. False where the warp has no inverse.
bool TrackBuilder::move_back(const Frame& frame, const UnitMotion& motion, Point target,
                             Point* source) {
  if (motion.warp < 0) {
    *source = {target.x - motion.dx, target.y - motion.dy};
    return true;
  }
  double x = 0;
  double y = 0;
  if (!invert_warp(frame.warps.data() + motion.warp, target.x, target.y, &x, &y)) return false;
  *source = {static_cast<float>(x), static_cast<float>(y)};
  return true;
}

}  // namespace colmap_av1::tracks
