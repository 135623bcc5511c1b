#include "tracks/chaining.h"

#include <algorithm>
#include <cstddef>
#include <optional>
#include <utility>

namespace colmap_av1::tracks {

Chainer::Chainer(const TrackBuilderOptions& options, const CellGrid& grid)
    : grid_(grid), bridge_(static_cast<float>(options.bridge.value_or(0))), cosine_(options) {}

void Chainer::chain(ChainedFrame& current, std::span<Link> links, TrackStore& store) {
  current_ = &current;
  store_ = &store;
  cosine_.start_frame(current);
  collect_open_units(links);
  for (Link& link : links) {
    cosine_.prepare(current, link);
    if (link.forward) {
      for (int list = 0; list < link.other->motion.num_lists; ++list) chain_forward(link, list);
      continue;
    }
    chain_backward(link);
  }
}

// Collects the units whose motion may continue a track into the current frame.
void Chainer::collect_open_units(std::span<const Link> links) {
  open_units_.clear();
  if (std::all_of(links.begin(), links.end(), [](const Link& link) { return link.forward; })) {
    return;
  }
  const TrustedMotion& motion = current_->motion;
  for (int row = 0; row < motion.visible_rows; ++row) {
    for (int col = 0; col < motion.visible_cols; ++col) {
      if (motion.moves(row * motion.cols + col)) open_units_.push_back({row, col});
    }
  }
}

// Whether any cell of a unit of the current frame has no track yet.
bool Chainer::is_open(OpenUnit unit) const {
  const int size = grid_.cells;
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

void Chainer::chain_backward(const Link& link) {
  collect_pending(*link.other);
  const int num_lists = current_->motion.num_lists;
  for (int list = 0; list < num_lists; ++list) chain_backward(link, list, Reach::kOwn);
  if (bridge_ <= 0.F) return;
  for (int list = 0; list < num_lists; ++list) chain_backward(link, list, Reach::kNeighbours);
}

// Uses the displacements of the current frame. Every free cell claims the longest track that it
// finds, and every track goes to the cell whose centre is nearest. This is a stable matching, so
// the order of cells does not matter.
void Chainer::chain_backward(const Link& link, int list, Reach reach) {
  const auto& motion = current_->motion.lists[list];
  claims_.resize(link.other->cells.size());
  neighbours_of_ = -1;
  // If a cell is as large as its unit, searching it is as fast as checking the unit first.
  const bool judges_units = grid_.cells > 1;
  std::size_t num_open = 0;
  for (const OpenUnit open : open_units_) {
    if (!is_open(open)) continue;
    open_units_[num_open++] = open;
    const int unit = open.row * current_->motion.cols + open.col;
    if (!link.refs[motion[unit].ref]) continue;
    if (judges_units && !may_find_track(link, unit, motion[unit], reach)) continue;
    for (int part = 0; part < grid_.cells * grid_.cells; ++part) {
      const int row = grid_.cells * open.row + (part >> grid_.log_cells);
      const int col = grid_.cells * open.col + (part & (grid_.cells - 1));
      const int cell = row * current_->cell_cols + col;
      if (current_->cells[cell].track >= 0) continue;
      claim_track(link, list, reach, {cell, unit, grid_.centre(row, col)});
    }
  }
  open_units_.resize(num_open);
  for (const std::int32_t cell : claimed_) {
    const Claim claim = std::exchange(claims_[cell], Claim{});
    continue_track(*link.other, cell, claim.cell, claim);
    mark_continued(*link.other, cell);
  }
  claimed_.clear();
}

// Collects the cells of a frame whose tracks are not yet continued into the current frame.
void Chainer::collect_pending(const ChainedFrame& other) {
  pending_.resize(other.cells.size());
  pending_units_.assign(other.motion.mi_size.size(), 0);
  std::size_t cell = 0;
  for (int row = 0; row < other.cell_rows; ++row) {
    std::uint8_t* unit = pending_units_.data() +
                         static_cast<std::ptrdiff_t>(row >> grid_.log_cells) * other.motion.cols;
    for (int col = 0; col < other.cell_cols; ++col, ++cell) {
      pending_[cell] = store_->is_pending(other.cells[cell], *current_) ? 1 : 0;
      unit[col >> grid_.log_cells] |= pending_[cell];
    }
  }
}

// Records that the track of a cell has been continued.
void Chainer::mark_continued(const ChainedFrame& other, int cell) {
  pending_[cell] = 0;
  const int size = grid_.cells;
  const int row = cell / other.cell_cols >> grid_.log_cells;
  const int col = cell % other.cell_cols >> grid_.log_cells;
  const std::uint8_t* first = pending_.data() +
                              static_cast<std::ptrdiff_t>(size) * row * other.cell_cols +
                              static_cast<std::ptrdiff_t>(size) * col;
  std::uint8_t any = 0;
  for (int r = 0; r < size; ++r, first += other.cell_cols) {
    for (int c = 0; c < size; ++c) any |= first[c];
  }
  pending_units_[row * other.motion.cols + col] = any;
}

// Whether the cells of a unit can find any track; otherwise they need not be searched.
bool Chainer::may_find_track(const Link& link, int unit, const UnitMotion& motion,
                             Reach reach) const {
  // A valid warp stretches a unit by less than half its size, and neighbours move similarly.
  float pixels = 0.75F * kUnit;
  if (reach == Reach::kNeighbours) {
    if (bridge_ > kUnit) return true;
    pixels += bridge_;
  }
  const Point centre = current_->motion.unit_centre(unit);
  const Window window = around(link, {centre.x + motion.dx, centre.y + motion.dy}, pixels);
  if (window.bottom < window.top || window.right < window.left) return false;
  const int shift = grid_.log_cells;
  for (int row = window.top >> shift; row <= window.bottom >> shift; ++row) {
    for (int col = window.left >> shift; col <= window.right >> shift; ++col) {
      if (pending_units_[row * link.other->motion.cols + col] != 0) return true;
    }
  }
  return false;
}

// Lets a cell claim a track. If another cell loses this track, it searches for another one in turn.
void Chainer::claim_track(const Link& link, int list, Reach reach, Searcher searcher) {
  while (true) {
    Found best;
    if (reach == Reach::kOwn) {
      best = find_track(link, searcher, current_->motion.lists[list][searcher.unit], best);
    } else {
      collect_neighbour_motion(link, list, searcher.unit);
      for (const UnitMotion* motion : neighbour_motion_) {
        best = find_track(link, searcher, *motion, best);
      }
    }
    if (best.cell < 0) return;
    if (claims_[best.cell].cell < 0) claimed_.push_back(best.cell);
    const int cell = std::exchange(claims_[best.cell], best.claim).cell;
    if (cell < 0) return;
    searcher = {cell, current_->unit_of(grid_, cell),
                grid_.centre(cell / current_->cell_cols, cell % current_->cell_cols)};
  }
}

// The longest track to which the motion of a unit leads, among those that no cell with a better
// claim holds; `best` if that is longer.
Chainer::Found Chainer::find_track(const Link& link, const Searcher& searcher,
                                   const UnitMotion& motion, Found best) const {
  const ChainedFrame& other = *link.other;
  const Point centre = searcher.centre;
  // A valid warp stretches a unit by less than half its size, about the unit's centre.
  const float reach = motion.warp < 0 ? grid_.half_cell : grid_.half_cell + kUnit / 4.F;
  const Window window = around(link, {centre.x + motion.dx, centre.y + motion.dy}, reach);
  for (int row = window.top; row <= window.bottom; ++row) {
    for (int col = window.left; col <= window.right; ++col) {
      const int index = row * other.cell_cols + col;
      if (pending_[index] == 0) continue;
      const Cell& found = other.cells[index];
      const Point target{found.position.x * link.from_picture_x,
                         found.position.y * link.from_picture_y};
      const std::optional<Point> position = move_back(current_->motion, motion, target);
      if (!position || !grid_.is_in_cell(*position, centre)) continue;
      Claim claim;
      claim.position = *position;
      claim.cell = searcher.cell;
      claim.cost = distance(*position, centre);
      claim.variance = found.variance + motion.variance;
      if ((best.cell >= 0 && !is_preferred(other, index, claim, best.cell, best.claim)) ||
          !current_->motion.contains(*position) || !is_better(claim, claims_[index])) {
        continue;
      }
      const std::optional<Point> velocity = cosine_.passed(link, index, *position, target);
      if (!velocity) continue;
      claim.velocity = *velocity;
      best = {index, claim};
    }
  }
  return best;
}

// Collects the displacements of neighbouring units that the cells of a unit use as well. Where the
// displacements of neighbouring blocks diverge, tracks lie in the gap between their targets.
void Chainer::collect_neighbour_motion(const Link& link, int list, int unit) {
  if (unit == neighbours_of_) return;
  neighbours_of_ = unit;
  neighbour_motion_.clear();
  const TrustedMotion& frame = current_->motion;
  const int row = unit / frame.cols;
  const int col = unit % frame.cols;
  const auto& motion = frame.lists[list];
  const UnitMotion& own = motion[unit];
  const auto is_same = [](const UnitMotion& a, const UnitMotion& b) {
    return a.dx == b.dx && a.dy == b.dy && a.warp == b.warp;
  };
  for (int r = std::max(0, row - 1); r <= std::min(frame.visible_rows - 1, row + 1); ++r) {
    for (int c = std::max(0, col - 1); c <= std::min(frame.visible_cols - 1, col + 1); ++c) {
      const UnitMotion& other = motion[r * frame.cols + c];
      if (!link.refs[other.ref] || !moves_alike(other, own, bridge_)) continue;
      // The cells have already searched there.
      if (is_same(other, own)) continue;
      if (std::any_of(neighbour_motion_.begin(), neighbour_motion_.end(),
                      [&](const UnitMotion* used) { return is_same(other, *used); })) {
        continue;
      }
      neighbour_motion_.push_back(&other);
    }
  }
}

// Ties are broken by block size, because vectors of small blocks are better.
bool Chainer::is_better(const Claim& claim, const Claim& holder) const {
  if (holder.cell < 0) return true;
  if (claim.cost != holder.cost) return claim.cost < holder.cost;
  const auto area = [this](const Claim& c) {
    return current_->motion.block_area(current_->unit_of(grid_, c.cell));
  };
  return area(claim) != area(holder) ? area(claim) < area(holder) : claim.cell < holder.cell;
}

// The cells of the other frame within reach of a position in coded pixels of the current frame.
// Cells that begin exactly at the right or lower limit are excluded.
Chainer::Window Chainer::around(const Link& link, Point position, float reach) {
  // The clamp keeps the cast defined for positions far outside, where there are no cells.
  const auto first = [](float cell, int count) {
    return static_cast<int>(std::clamp(cell, 0.F, static_cast<float>(count)));
  };
  const auto last = [](float cell, int count) {
    const float clamped = std::clamp(cell, 0.F, static_cast<float>(count));
    const int floor = static_cast<int>(clamped);
    return (static_cast<float>(floor) == clamped ? floor : floor + 1) - 1;
  };
  const ChainedFrame& other = *link.other;
  return {first((position.y - reach) * link.to_cells_y, other.cell_rows),
          last((position.y + reach) * link.to_cells_y, other.cell_rows),
          first((position.x - reach) * link.to_cells_x, other.cell_cols),
          last((position.x + reach) * link.to_cells_x, other.cell_cols)};
}

// Uses the displacements of the other frame. Every track moves with its unit, and a free cell gets
// the longest track that lands in it.
void Chainer::chain_forward(const Link& link, int list) {
  ChainedFrame& other = *link.other;
  const auto& motion = other.motion.lists[list];
  claims_.resize(current_->cells.size());
  for (int row = 0; row < grid_.cells * other.motion.visible_rows; ++row) {
    for (int col = 0; col < grid_.cells * other.motion.visible_cols; ++col) {
      const int cell = row * other.cell_cols + col;
      const int unit = (row >> grid_.log_cells) * other.motion.cols + (col >> grid_.log_cells);
      if (link.refs[motion[unit].ref] && store_->is_pending(other.cells[cell], *current_)) {
        claim_cell(link, cell, motion[unit]);
      }
    }
  }
  for (const std::int32_t cell : claimed_) {
    const Claim claim = std::exchange(claims_[cell], Claim{});
    continue_track(other, claim.cell, cell, claim);
  }
  claimed_.clear();
}

// Claims the cell of the current frame in which a track of the other frame lands.
void Chainer::claim_cell(const Link& link, int cell, const UnitMotion& motion) {
  const ChainedFrame& other = *link.other;
  const Cell& source = other.cells[cell];
  const Point from{source.position.x / other.motion.upscale, source.position.y};
  const Point moved = move(other.motion, motion, from);
  const float scale_x = current_->motion.coded_width / other.motion.coded_width;
  const float scale_y = current_->motion.height / other.motion.height;
  Claim claim;
  claim.cell = cell;
  claim.position = {moved.x * scale_x, moved.y * scale_y};
  claim.variance = source.variance + motion.variance;
  if (!current_->motion.contains(claim.position)) return;
  const float size = 2.F * grid_.half_cell;
  const int target_row = static_cast<int>(claim.position.y / size);
  const int target_col = static_cast<int>(claim.position.x / size);
  const int target = target_row * current_->cell_cols + target_col;
  if (current_->cells[target].track >= 0) return;
  claim.cost = distance(claim.position, grid_.centre(target_row, target_col));
  const Claim& holder = claims_[target];
  if (holder.cell >= 0 && !is_preferred(other, cell, claim, holder.cell, holder)) return;
  const std::optional<Point> velocity = cosine_.passed(link, cell, from, moved);
  if (!velocity) return;
  claim.velocity = *velocity;
  if (holder.cell < 0) claimed_.push_back(target);
  claims_[target] = claim;
}

// If two tracks lead to one cell, the longer one is continued, because a new one can start at any
// time.
bool Chainer::is_preferred(const ChainedFrame& frame, int cell, const Claim& claim, int other_cell,
                           const Claim& other_claim) const {
  const std::int32_t own_length = store_->length(frame, frame.cells[cell]);
  const std::int32_t other_length = store_->length(frame, frame.cells[other_cell]);
  return own_length != other_length ? own_length > other_length : claim.cost < other_claim.cost;
}

// Continues the track in a cell of another frame into a cell of the current frame.
void Chainer::continue_track(ChainedFrame& other, int other_cell, int cell, const Claim& claim) {
  std::int32_t track = other.cells[other_cell].track;
  if (track == kSeed) track = store_->start(other, static_cast<std::size_t>(other_cell));
  current_->cells[cell] = {
      track, {claim.position.x * current_->motion.upscale, claim.position.y}, claim.variance};
  if (cosine_.is_on()) current_->velocity[cell] = claim.velocity;
  store_->hold(track, *current_);
}

}  // namespace colmap_av1::tracks
