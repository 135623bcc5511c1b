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

// Frames are added in bitstream order and chained in display order. Tracks therefore reach a frame
// that was coded far ahead in short steps through the frames between, not by its own long and
// inaccurate vectors. Memory holds the frames in reference slots, the frames that displacements
// link to a frame that is not chained yet, and the tracks of the store.
class TrackBuilder {
 public:
  // Throws std::invalid_argument for cells into which a unit cannot be divided.
  explicit TrackBuilder(const TrackBuilderOptions& options);
  TrackBuilder(const TrackBuilder&) = delete;
  TrackBuilder& operator=(const TrackBuilder&) = delete;
  TrackBuilder(TrackBuilder&&) = default;
  TrackBuilder& operator=(TrackBuilder&&) = default;

  // Throws std::invalid_argument for inconsistent block data or a wrong order of frames.
  void add(const FrameMotion& frame);

  struct Result {
    TrackArrays tracks;
    TrackArrays ends;
  };
  // The kept tracks, and the ends of some tracks, in the order of their seeds. The builder is empty
  // afterwards.
  Result finish();

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
  int last_display_ = -1;  // all frames up to this display index have been output
  std::int32_t frames_chained_ = 0;
  std::int64_t next_serial_ = 0;
  std::vector<std::unique_ptr<ChainedFrame>> frames_;       // in bitstream order
  std::vector<std::unique_ptr<ChainedFrame>> idle_frames_;  // their memory is reused
  TrustScratch scratch_;
};

}  // namespace colmap_av1::tracks
