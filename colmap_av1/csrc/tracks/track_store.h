// Keeps tracks while they live, and those that are long enough beyond.
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

// Memory: the observations of tracks that are alive or long enough to keep, in the frames whose
// observations are wanted.
class TrackStore {
 public:
  // `observed`: display indices of these frames; without a value all are, else a track that only
  // one of them sees is not kept.
  TrackStore(int min_length, std::optional<std::vector<std::int32_t>> observed);

  // Size of the pictures that positions are given in.
  void set_size(int width, int height);
  bool has_size() const { return width_ != 0; }

  // Shown frames that have seen a cell's track.
  std::int32_t length(const ChainedFrame& frame, const Cell& cell) const {
    if (cell.track == kSeed) return frame.is_shown() ? 1 : 0;
    return tracks_[cell.track].length;
  }
  // Whether a cell holds a track that has no place in a frame yet.
  bool is_unplaced(const Cell& cell, const ChainedFrame& frame) const {
    return cell.track == kSeed || (cell.track != kNoTrack && last_seen_[cell.track] != frame.order);
  }

  // Makes a track of the seed in a cell, seen there where the frame is shown.
  std::int32_t start(ChainedFrame& frame, std::size_t cell);
  // Another frame holds the track.
  void hold(std::int32_t track, const ChainedFrame& frame) {
    last_seen_[track] = frame.order;
    ++tracks_[track].frames;
  }
  // A shown frame sees the tracks that it holds.
  void observe(const ChainedFrame& frame);
  // A frame is gone: a track that no frame holds any more is over.
  void release(ChainedFrame& frame);

  // The kept tracks in the order of their seeds. No frame holds a track any more; the store is of
  // no use afterwards.
  TrackArrays finish();

 private:
  // Small: tracks are looked up all the time, in no order.
  struct Track {
    std::int32_t last_stretch = -1;
    std::int32_t length = 0;    // shown frames that have seen it
    std::int32_t observed = 0;  // observations that are kept of it
    std::int32_t frames = 0;    // that hold it
  };
  struct Observation {
    std::int32_t frame = 0;
    Point position;
    float sigma = 0.F;
  };
  // Observations of a track that lives, a line of the cache at a time.
  static constexpr int kStretch = 4;
  struct alignas(64) Stretch {
    std::array<Observation, kStretch> observations;
  };
  // Those of the tracks that are kept. A deque grows without being copied.
  struct Done {
    std::deque<std::int32_t> frame;
    std::deque<float> xy;
    std::deque<float> sigma;
  };
  struct Kept {
    std::int64_t serial = 0;
    std::ptrdiff_t first = 0;  // of its observations among those that are done
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
  std::vector<std::int32_t> last_seen_;  // order of the last frame that took each track up
  std::vector<std::int64_t> serials_;    // of the tracks' seeds
  std::vector<std::int32_t> free_tracks_;
  std::deque<Stretch> stretches_;
  std::vector<std::int32_t> previous_stretch_;  // of the same track, by stretch
  std::vector<std::int32_t> free_stretches_;
  std::vector<Kept> kept_;  // in the order in which they ended, as their observations are
  Done done_;
};

}  // namespace colmap_av1::tracks
