// Chains the displacements of coded frames into point tracks.

#ifndef COLMAP_AV1_TRACKS_TRACK_BUILDER_H_
#define COLMAP_AV1_TRACKS_TRACK_BUILDER_H_

#include <array>
#include <cstddef>
#include <cstdint>
#include <deque>
#include <memory>
#include <span>
#include <vector>

#include "tracks/displacement.h"
#include "tracks/dominant_motion.h"

namespace colmap_av1::tracks {

// Limits that are switched off hold a negative value, the cosine one below -1. Meaning
// and units: TrackOptions in options.py.
struct TrackBuilderOptions {
  int min_length = 4;
  double cosine = -2;
  bool cosine_relative_to_dominant = true;
  double cosine_scale = 1;
  int max_interval = -1;
  int max_block_area = -1;
  int max_uncoded_block_area = -1;
  double smoothness = -1;
  double interpolation = -1;
  double border = -1;
  double bridge = -1;
  int cells = 1;    // along either side of a unit
  int seeding = 1;  // along either side of a square of them that a track starts in; divides cells
};

// One coded frame. Borrowed for the call.
struct CodedFrame {
  MotionField field;
  const uint8_t* skip = nullptr;
  int decode_index = 0;
  int display_index = -1;
  bool show_frame = true;
  int width = 0;   // UpscaledWidth
  int height = 0;  // FrameHeight
  const int32_t* ref_decode_index = nullptr;   // [8]
  const int32_t* ref_display_index = nullptr;  // [8]
  const int32_t* slot_decode_index = nullptr;  // [8]
};

struct TrackArrays {
  int num_frames = 0;
  int width = 0;
  int height = 0;
  std::vector<int64_t> offsets;
  std::vector<int32_t> frame;
  std::vector<float> xy;
  std::vector<float> sigma;
};

// Frames come in bitstream order and are chained in display order, so that a frame that
// was coded far ahead is reached by the short steps of the frames between, not by its own
// long and poor vectors. Memory: the frames in reference slots, those that displacements
// still link to a frame that waits for its turn, and the observations of tracks that are
// alive or long enough to keep.
class TrackBuilder {
 public:
  explicit TrackBuilder(const TrackBuilderOptions& options);
  TrackBuilder(const TrackBuilder&) = delete;
  TrackBuilder& operator=(const TrackBuilder&) = delete;
  TrackBuilder(TrackBuilder&&) = default;
  TrackBuilder& operator=(TrackBuilder&&) = default;

  // Throws std::invalid_argument for block data or an order of frames that contradicts
  // itself.
  void add(const CodedFrame& frame);

  // The kept tracks in the order of their seeds. The builder is empty afterwards.
  TrackArrays finish();

 private:
  struct Point {
    float x = 0.F;
    float y = 0.F;
  };
  // What a unit, or one of the equal parts that a unit is cut into, holds: at most one track, at
  // its sub-pixel place in pixels of the picture. Most seeds are never carried on: a seed becomes
  // a track when it is.
  static constexpr int32_t kNone = -1;
  static constexpr int32_t kSeed = -2;
  struct Cell {
    int32_t track = kNone;
    Point position;
    float variance = 0.F;  // of the position against the track's seed, in coded px^2
  };
  // A unit's motion by one of its lists, after the trust rules: ref 0 where untrusted.
  struct UnitMotion {
    float dx = 0.F;  // at the unit's centre, in coded pixels
    float dy = 0.F;
    int32_t warp = -1;  // first of six entries of Frame::warps
    float variance = 0.F;  // expected of the displacement, in coded px^2
    int8_t ref = 0;
  };
  struct Frame {
    int decode_index = -1;
    int display_index = -1;
    bool chained = false;
    int rows = 0;
    int cols = 0;
    int visible_rows = 0;
    int visible_cols = 0;
    int cell_rows = 0;
    int cell_cols = 0;
    float width = 0.F;
    float height = 0.F;
    float coded_width = 0.F;
    float upscale = 1.F;  // picture pixels to a coded one, above 1 by super-resolution
    std::array<int, kNumRefs> ref_decode_index{};
    std::array<int, kNumRefs> ref_interval{};  // in shown frames, 0 where unknown
    std::array<std::vector<UnitMotion>, 2> motion;  // the second stays unused without compounds
    int num_lists = 0;
    std::array<int, kNumRefs> num_linked{};  // entries of `motion`, by their ref
    std::vector<int32_t> warps;
    std::vector<uint8_t> mi_size;
    int64_t first_serial = 0;  // of the seed in the first cell
    std::vector<Cell> cells;
    // Velocity per shown frame by which the track came here, less the frame's dominant
    // motion; NaN at a seed. Empty without the cosine test.
    std::vector<Point> velocity;

    std::span<std::vector<UnitMotion>> lists() { return std::span(motion).first(num_lists); }
    std::span<const std::vector<UnitMotion>> lists() const {
      return std::span(motion).first(num_lists);
    }
    bool moves(int unit) const {
      return motion[0][unit].ref != 0 || (num_lists > 1 && motion[1][unit].ref != 0);
    }
  };
  // Small: tracks are looked up all the time, in no order.
  struct Track {
    int32_t last_seen = -1;  // number of the frame in the order of chaining
    int32_t last_stretch = -1;
    int32_t length = 0;
    int32_t frames = 0;  // that hold it
  };
  struct Observation {
    int32_t frame = 0;
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
    std::deque<int32_t> frame;
    std::deque<float> xy;
    std::deque<float> sigma;
  };
  struct Kept {
    int64_t serial = 0;
    std::ptrdiff_t first = 0;  // of its observations among those that are done
    int32_t length = 0;
  };
  // A frame with tracks that displacements link to the frame being chained: from the
  // current frame's units (backward) or from the other's (forward).
  struct Link {
    Frame* other = nullptr;
    bool forward = false;
    std::array<bool, kNumRefs> refs{};  // the RefFrame values that name the link
    int distance = 0;                   // in shown frames
    int interval = 0;                   // other less current display index, 0 if unknown
    // To coded pixels of the current frame, from pixels of the other's picture and to its cells.
    float from_picture_x = 1.F;
    float from_picture_y = 1.F;
    float to_cells_x = 1.F;
    float to_cells_y = 1.F;
    // To the current picture, from the other one.
    float picture_x = 1.F;
    float picture_y = 1.F;
    // To pixels of the current picture per shown frame, from a displacement.
    double to_velocity_x = 0;
    double to_velocity_y = 0;
    DominantMotion dominant;            // of the field that the displacements come from
  };
  // What a cell would do with a track, and how well it fits.
  struct Claim {
    int32_t cell = -1;  // of the frame whose displacement it is
    float cost = 0.F;   // distance from the claiming cell's centre, in coded pixels
    Point position;  // in the current frame, coded pixels
    Point velocity;
    float variance = 0.F;
  };
  // How far to trust a block's motion.
  struct Verdict {
    float variance = 0.F;
    bool rough = false;
  };
  // How the units around a block move, against the block.
  struct Agreement {
    int judged = 0;
    int agreeing = 0;
    double distance = 0;  // summed over the judged ones
  };
  struct OpenUnit {
    int32_t row = 0;
    int32_t col = 0;
  };
  struct Window {
    int top = 0;
    int bottom = -1;  // included, as is right
    int left = 0;
    int right = -1;
  };

  // Whose displacements a cell looks for tracks by: its unit's, or those of the units beside.
  enum class Reach { kOwn, kBeside };

  bool uses_cosine() const { return options_.cosine >= -1; }
  Frame* find_frame(int decode_index) const;
  bool is_waiting(int display_index) const;
  Frame& read_frame(const CodedFrame& coded);
  void judge_blocks(Frame& frame, const CodedFrame& coded);
  void interpolate(Frame& frame);
  void bridge(Frame& frame);
  bool moves_alike(const UnitMotion& a, const UnitMotion& b) const;
  Agreement judge_border(const Frame& frame, int row, int col, int list) const;
  void chain_up_to(int display_index);
  void chain_frame(Frame& frame);
  void find_links();
  bool is_within_reach(int interval) const;
  bool links(const Frame& from, const Frame& to) const;
  void fit_dominant(Link& link);
  void note_open_units();
  bool is_open(OpenUnit unit) const;
  void chain_backward(const Link& link, int list, Reach reach);
  void chain_forward(const Link& link, int list);
  void note_unplaced_units(const Frame& other);
  bool may_find_track(const Link& link, int unit, const UnitMotion& motion, Reach reach) const;
  void find_track(const Link& link, int cell, Point centre, const UnitMotion& motion, int* best,
                  Claim* best_claim) const;
  void find_track_beside(const Link& link, int list, int cell, Point centre, int* best,
                         Claim* best_claim) const;
  bool is_preferred(const Frame& frame, int cell, const Claim& claim, int other_cell,
                    const Claim& other_claim) const;
  bool is_better(const Claim& claim, const Claim& holder) const;
  static float distance(Point a, Point b);
  bool passes_cosine(const Link& link, int other_cell, Point from, Point moved,
                     Claim* claim) const;
  bool is_unplaced(const Cell& cell) const;
  int32_t length(const Frame& frame, const Cell& cell) const;
  void carry_on(Frame& other, int other_cell, int cell, const Claim& claim);
  int32_t start_track(Frame& frame, int cell);
  void seed();
  void observe();
  void observe(Track& track, const Frame& frame, const Cell& cell);
  void release_frames(const int32_t* slots);
  void release(Frame& frame);
  void start_stretch(Track& track);
  void keep(int32_t index);
  static Window around(const Link& link, Point position, float reach);
  int unit_of(const Frame& frame, int cell) const;
  static Point unit_centre(const Frame& frame, int unit);
  Point cell_centre(int row, int col) const;
  bool is_in_cell(Point position, Point centre) const;
  bool is_in_picture(Point position) const;
  static Point move(const Frame& frame, const UnitMotion& motion, Point position);
  static bool move_back(const Frame& frame, const UnitMotion& motion, Point target,
                        Point* source);

  TrackBuilderOptions options_;
  int log_cells_;    // to the base 2, of the cells along either side of a unit
  float half_cell_;  // half a cell's width, in coded pixels
  int width_ = 0;  // of the output's coordinates
  int height_ = 0;
  int num_frames_ = 0;
  int last_display_ = -1;  // of the frames shown so far
  int32_t frames_chained_ = 0;
  int64_t next_serial_ = 0;
  std::vector<Track> tracks_;
  std::vector<int64_t> serials_;  // of the tracks' seeds
  std::vector<int32_t> free_tracks_;
  std::deque<Stretch> stretches_;
  std::vector<int32_t> previous_stretch_;  // of the same track, by stretch
  std::vector<int32_t> free_stretches_;
  std::vector<Kept> kept_;  // in the order in which they ended, as their observations are
  Done done_;
  std::vector<std::unique_ptr<Frame>> frames_;       // in bitstream order
  std::vector<std::unique_ptr<Frame>> idle_frames_;  // their memory is used again

  // The frame being chained, and buffers that are kept from frame to frame.
  Frame* current_ = nullptr;
  std::vector<Link> links_;
  std::vector<Claim> claims_;      // by cell, free between links
  std::vector<int32_t> claimed_;   // those that are not
  std::vector<OpenUnit> open_units_;      // of the current frame, in raster order
  std::vector<uint8_t> unplaced_units_;    // of a frame with tracks
  std::array<std::vector<Verdict>, 2> verdicts_;
  std::vector<UnitMotion> block_motion_;
  std::vector<MotionSample> samples_;
  std::vector<float> scratch_;
};

}  // namespace colmap_av1::tracks

#endif  // COLMAP_AV1_TRACKS_TRACK_BUILDER_H_
