#include "tracks/track_builder.h"

#include <algorithm>
#include <cstddef>
#include <limits>
#include <stdexcept>
#include <utility>

namespace colmap_av1::tracks {
namespace {

bool is_in(std::span<const std::int32_t> slots, const ChainedFrame& frame) {
  return std::ranges::find(slots, frame.motion.decode_index) != slots.end();
}

}  // namespace

TrackBuilder::TrackBuilder(const TrackBuilderOptions& options)
    : options_(options), grid_(options.cells), chainer_(options, grid_), store_(options) {
  const auto is_part = [](int count) { return count == 1 || count == 2 || count == 4; };
  const int size = options.seeding;
  if (!is_part(options.cells) || !(is_part(size) || size == 2 * options.cells) ||
      size > 2 * options.cells) {
    throw std::invalid_argument("cells are 1, 2 or 4, seeding one of these, to twice as many");
  }
  if (options.tracks_per_sample < 0) throw std::invalid_argument("tracks_per_sample is negative");
}

void TrackBuilder::add(const FrameMotion& motion) {
  check_frame_motion(motion);
  check_order(motion);
  if (motion.display_index >= 0) {
    if (!store_.has_size()) store_.set_size(motion.width, motion.height);
    num_frames_ = std::max(num_frames_, motion.display_index + 1);
  }
  ChainedFrame& frame = read_frame(motion);
  if (!frame.is_shown()) chain_frame(frame);
  // A shown frame that is in no reference slot has been output. Frames are output in display order,
  // so all frames before it have been read.
  for (const auto& other : frames_) {
    const bool is_output =
        other.get() == &frame ? motion.show_frame : !is_in(motion.slot_decode_index, *other);
    if (!other->is_chained() && is_output) {
      last_display_ = std::max(last_display_, other->motion.display_index);
    }
  }
  chain_up_to(last_display_);
  release_frames(motion.slot_decode_index);
}

TrackBuilder::Result TrackBuilder::finish() {
  chain_up_to(std::numeric_limits<int>::max());
  for (const auto& frame : frames_) store_.release(*frame);
  frames_.clear();
  idle_frames_.clear();
  Result result{store_.finish(), store_.finish_ends()};
  result.tracks.num_frames = result.ends.num_frames = num_frames_;
  *this = TrackBuilder(options_);
  return result;
}

void TrackBuilder::check_order(const FrameMotion& motion) const {
  const auto is_index = [](int index) { return index < std::numeric_limits<int>::max(); };
  if (motion.width < 1 || !is_index(motion.display_index) ||
      !std::all_of(motion.ref_display_index.begin(), motion.ref_display_index.end(), is_index)) {
    throw std::invalid_argument("a width or a display_index is out of range");
  }
  if (std::any_of(frames_.begin(), frames_.end(), [&](const auto& frame) {
        return frame->motion.decode_index == motion.decode_index;
      })) {
    throw std::invalid_argument("a decode_index occurs twice");
  }
  if (motion.display_index >= 0 &&
      (motion.display_index <= last_display_ || is_waiting(motion.display_index))) {
    throw std::invalid_argument(
        "the frames are not in bitstream order: a display_index comes twice or too late");
  }
}

bool TrackBuilder::is_waiting(int display_index) const {
  return std::any_of(frames_.begin(), frames_.end(), [display_index](const auto& frame) {
    return !frame->is_chained() && frame->motion.display_index == display_index;
  });
}

ChainedFrame& TrackBuilder::read_frame(const FrameMotion& motion) {
  RefDetail ref_has_detail{};
  for (int ref = 1; ref < kNumRefs; ++ref) {
    ref_has_detail[ref] = std::ranges::any_of(frames_, [&](const auto& frame) {
      return frame->motion.decode_index == motion.ref_decode_index[ref] && frame->motion.has_detail;
    });
  }
  if (idle_frames_.empty()) idle_frames_.push_back(std::make_unique<ChainedFrame>());
  frames_.push_back(std::move(idle_frames_.back()));
  idle_frames_.pop_back();
  ChainedFrame& frame = *frames_.back();
  read_trusted_motion(motion, options_, ref_has_detail, scratch_, frame.motion);
  frame.order = -1;
  frame.cell_rows = grid_.cells * frame.motion.rows;
  frame.cell_cols = grid_.cells * frame.motion.cols;
  return frame;
}

void TrackBuilder::chain_up_to(int display_index) {
  while (true) {
    ChainedFrame* next = nullptr;
    for (const auto& frame : frames_) {
      if (!frame->is_chained() && frame->motion.display_index <= display_index &&
          (next == nullptr || frame->motion.display_index < next->motion.display_index)) {
        next = frame.get();
      }
    }
    if (next == nullptr) return;
    chain_frame(*next);
  }
}

void TrackBuilder::chain_frame(ChainedFrame& frame) {
  frame.order = frames_chained_++;
  frame.cells.assign(static_cast<std::size_t>(frame.cell_rows) * frame.cell_cols, Cell{});
  frame.first_serial = next_serial_;
  next_serial_ += static_cast<std::int64_t>(frame.cells.size());
  std::vector<Link> links = find_links(frame, frames_, grid_, options_);
  chainer_.chain(frame, links, store_);
  seed(frame);
  if (frame.is_shown()) store_.observe(frame);
}

// Starts a track in the centre of every square of `seeding` x `seeding` cells without a track.
void TrackBuilder::seed(ChainedFrame& frame) const {
  const int size = options_.seeding;
  const float half = grid_.half_cell * static_cast<float>(size);
  const auto is_empty = [&](int row, int col) {
    // Squares larger than a unit may extend beyond the frame.
    for (int r = row; r < std::min(row + size, frame.cell_rows); ++r) {
      for (int c = col; c < std::min(col + size, frame.cell_cols); ++c) {
        if (frame.cells[r * frame.cell_cols + c].track != kNoTrack) return false;
      }
    }
    return true;
  };
  for (int row = 0; row < grid_.cells * frame.motion.visible_rows; row += size) {
    for (int col = 0; col < grid_.cells * frame.motion.visible_cols; col += size) {
      if (!is_empty(row, col)) continue;
      const Point centre{2.F * grid_.half_cell * static_cast<float>(col) + half,
                         2.F * grid_.half_cell * static_cast<float>(row) + half};
      if (!frame.motion.contains(centre)) continue;
      const int cell = (row + size / 2) * frame.cell_cols + col + size / 2;
      frame.cells[cell] = {kSeed, {centre.x * frame.motion.upscale, centre.y}, 0.F};
    }
  }
}

// Releases the frames to which no later frame can be linked.
void TrackBuilder::release_frames(std::span<const std::int32_t> slots) {
  const auto is_needed = [&](const ChainedFrame& frame) {
    if (!frame.is_chained() || is_in(slots, frame)) return true;
    return std::any_of(frames_.begin(), frames_.end(), [&](const auto& other) {
      return !other->is_chained() && (leads_to(other->motion, frame.motion, options_) ||
                                      leads_to(frame.motion, other->motion, options_));
    });
  };
  for (std::size_t i = 0; i < frames_.size();) {
    if (is_needed(*frames_[i])) {
      ++i;
      continue;
    }
    store_.release(*frames_[i]);
    idle_frames_.push_back(std::move(frames_[i]));
    frames_.erase(frames_.begin() + static_cast<std::ptrdiff_t>(i));
  }
}

}  // namespace colmap_av1::tracks
