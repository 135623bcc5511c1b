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
#include "tracks/track_builder_options.h"

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

// Stores the observations of tracks that are alive or kept, in all shown frames or in some of them.
class TrackStore {
 public:
  // With `stored_frames`, a track with fewer than two stored observations is not kept.
  explicit TrackStore(const TrackBuilderOptions& options);

  // Size of the pictures in whose pixels positions are given.
  void set_size(int width, int height);
  bool has_size() const { return width_ != 0; }

  // Number of shown frames in which a cell's track has been observed, stored or not.
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
  // Counts an observation of each track that a shown frame holds, and stores it if the frame is one
  // of those.
  void observe(const ChainedFrame& frame);
  // Releases a frame. A track that no frame holds any more ends.
  void release(ChainedFrame& frame);

  // Returns the kept tracks in the order of their seeds. No frame may hold a track any more, and
  // only `finish_ends` may be called afterwards.
  TrackArrays finish();
  // The ends of some of the long enough tracks, in the same order: one observation if they are the
  // same, else two.
  TrackArrays finish_ends();

 private:
  // Kept small, because tracks are accessed often and in random order.
  struct Track {
    std::int32_t last_chunk = -1;
    std::int32_t length = 0;      // number of shown frames in which it is observed
    std::int32_t num_stored = 0;  // number of stored observations
    std::int32_t frames = 0;      // number of frames that hold it
  };
  struct Observation {
    std::int32_t frame = 0;
    Point position;
    float sigma = 0.F;
  };
  // Some observations of a live track, in one cache line.
  static constexpr int kChunkSize = 4;
  struct alignas(64) Chunk {
    std::array<Observation, kChunkSize> observations;
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

  struct Ends {
    std::int64_t serial = 0;
    Observation first;
    Observation last;
  };

  // Counts an observation of a track in a shown frame, and stores it if `is_stored`.
  void count(std::int32_t index, const ChainedFrame& frame, const Cell& cell, bool is_stored);
  void store(Track& track, const Observation& observation);
  Observation observation(const ChainedFrame& frame, const Cell& cell) const;
  bool stores(const ChainedFrame& frame) const;
  bool is_sampled(std::int32_t index) const {
    if (tracks_per_sample_ == 0) return false;
    // Fibonacci hashing: a modulus of the serial numbers, which count cells, would choose whole
    // columns of the grid of seeds.
    const auto hash = static_cast<std::uint64_t>(serials_[index]) * 0x9E3779B97F4A7C15U >> 32U;
    return hash % static_cast<std::uint64_t>(tracks_per_sample_) == 0;
  }
  void start_chunk(Track& track);
  void keep(std::int32_t index);

  int min_length_;
  std::optional<std::vector<std::int32_t>> stored_frames_;  // ascending
  int tracks_per_sample_;
  int width_ = 0;
  int height_ = 0;
  std::vector<Track> tracks_;
  std::vector<std::int32_t> last_seen_;  // order of the last frame that continued each track
  std::vector<std::int64_t> serials_;    // serial numbers of the tracks' seeds
  std::vector<Ends> ends_;               // of the tracks that have ends
  std::vector<std::int32_t> free_tracks_;
  std::deque<Chunk> chunks_;
  std::vector<std::int32_t> previous_chunk_;  // by chunk, the previous one of the same track
  std::vector<std::int32_t> free_chunks_;
  std::vector<Kept> kept_;  // in the order in which they ended, like their observations
  Done done_;
  std::vector<Ends> kept_ends_;
};

}  // namespace colmap_av1::tracks
