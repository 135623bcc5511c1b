// Chains the motion of coded frames into point tracks.
#pragma once

#include <cstdint>
#include <memory>
#include <span>
#include <vector>

#include "tracks/chained_frame.h"
#include "tracks/chaining.h"
#include "tracks/frame_motion.h"
#include "tracks/link.h"
#include "tracks/track_builder_options.h"
#include "tracks/track_store.h"
#include "tracks/trusted_motion.h"

namespace colmap_av1::tracks {

// Frames come in bitstream order and are chained in display order, so that a frame that
// was coded far ahead is reached by the short steps of the frames between, not by its own
// long and poor vectors. Memory: the frames in reference slots, those that displacements
// still link to a frame that waits for its turn, and the store's tracks.
class TrackBuilder {
 public:
  // Throws std::invalid_argument for cells that no unit can be cut into.
  explicit TrackBuilder(const TrackBuilderOptions& options);
  TrackBuilder(const TrackBuilder&) = delete;
  TrackBuilder& operator=(const TrackBuilder&) = delete;
  TrackBuilder(TrackBuilder&&) = default;
  TrackBuilder& operator=(TrackBuilder&&) = default;

  // Throws std::invalid_argument for block data or an order of frames that contradicts
  // itself.
  void add(const FrameMotion& frame);

  // The kept tracks in the order of their seeds. The builder is empty afterwards.
  TrackArrays finish();

 private:
  void check_order(const FrameMotion& frame) const;
  bool is_waiting(int display_index) const;
  ChainedFrame& read_frame(const FrameMotion& frame);
  void chain_up_to(int display_index);
  void chain_frame(ChainedFrame& frame);
  void seed(ChainedFrame& frame) const;
  void release_frames(std::span<const std::int32_t> slots);

  TrackBuilderOptions options_;
  CellGrid grid_;
  Chainer chainer_;
  TrackStore store_;
  int num_frames_ = 0;
  int last_display_ = -1;  // of the frames shown so far
  std::int32_t frames_chained_ = 0;
  std::int64_t next_serial_ = 0;
  std::vector<std::unique_ptr<ChainedFrame>> frames_;       // in bitstream order
  std::vector<std::unique_ptr<ChainedFrame>> idle_frames_;  // their memory is used again
  TrustScratch scratch_;
};

}  // namespace colmap_av1::tracks
