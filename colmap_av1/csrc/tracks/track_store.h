// Stores tracks while they are alive, and keeps those that are long enough when they end.
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <deque>
#include <optional>
#include <vector>

#include "tracks/chained_frame.h"
#include "tracks/geometry.h"

namespace colmap_av1::tracks {

struct TrackArrays {
  int num_frames = 0;
  int width = 0;
  int height = 0;
  std::vector<std::int64_t> offsets;
  std::vector<std::int32_t> frame;
  std::vector<float> xy;
  std::vector<float> sigma;
};

// Holds the observations, in the observed frames, of tracks that are alive or long enough.
class TrackStore {
 public:
  // `observed`: display indices of the observed frames; without a value, all frames. With a value,
  // a track that is observed in only one of these frames is not kept.
  TrackStore(int min_length, std::optional<std::vector<std::int32_t>> observed);

  // Size of the pictures in whose pixels positions are given.
  void set_size(int width, int height);
  bool has_size() const { return width_ != 0; }

  // Number of shown frames in which a cell's track has been observed.
  std::int32_t length(const ChainedFrame& frame, const Cell& cell) const {
    if (cell.track == kSeed) return frame.is_shown() ? 1 : 0;
    return tracks_[cell.track].length;
  }
  // Whether a cell holds a track that is not continued into a frame yet.
  bool is_pending(const Cell& cell, const ChainedFrame& frame) const {
    return cell.track == kSeed || (cell.track != kNoTrack && last_seen_[cell.track] != frame.order);
  }

  // Turns the seed in a cell into a track, with an observation there if the frame is shown.
  std::int32_t start(ChainedFrame& frame, std::size_t cell);
  // Records that one more frame holds the track.
  void hold(std::int32_t track, const ChainedFrame& frame) {
    last_seen_[track] = frame.order;
    ++tracks_[track].frames;
  }
  // Adds observations of all tracks that a shown frame holds.
  void observe(const ChainedFrame& frame);
  // Releases a frame. A track that no frame holds any more ends.
  void release(ChainedFrame& frame);

  // Returns the kept tracks in the order of their seeds. No frame may hold a track any more, and
  // the store cannot be used afterwards.
  TrackArrays finish();

 private:
  // Kept small, because tracks are accessed often and in random order.
  struct Track {
    std::int32_t last_stretch = -1;
    std::int32_t length = 0;    // number of shown frames with an observation
    std::int32_t observed = 0;  // number of observations that are kept
    std::int32_t frames = 0;    // number of frames that hold it
  };
  struct Observation {
    std::int32_t frame = 0;
    Point position;
    float sigma = 0.F;
  };
  // Some observations of a live track, in one cache line.
  static constexpr int kStretch = 4;
  struct alignas(64) Stretch {
    std::array<Observation, kStretch> observations;
  };
  // Observations of finished tracks. A deque grows without copying.
  struct Done {
    std::deque<std::int32_t> frame;
    std::deque<float> xy;
    std::deque<float> sigma;
  };
  struct Kept {
    std::int64_t serial = 0;
    std::ptrdiff_t first = 0;  // index of its first observation among the finished ones
    std::int32_t length = 0;
  };

  void record(Track& track, const ChainedFrame& frame, const Cell& cell);
  bool is_observed(const ChainedFrame& frame) const;
  void start_stretch(Track& track);
  void keep(std::int32_t index);

  int min_length_;
  std::optional<std::vector<std::int32_t>> observed_;  // ascending
  int width_ = 0;
  int height_ = 0;
  std::vector<Track> tracks_;
  std::vector<std::int32_t> last_seen_;  // order of the last frame that continued each track
  std::vector<std::int64_t> serials_;    // serial numbers of the tracks' seeds
  std::vector<std::int32_t> free_tracks_;
  std::deque<Stretch> stretches_;
  std::vector<std::int32_t> previous_stretch_;  // by stretch, the previous one of the same track
  std::vector<std::int32_t> free_stretches_;
  std::vector<Kept> kept_;  // in the order in which they ended, like their observations
  Done done_;
};

}  // namespace colmap_av1::tracks
