// Continues tracks into a frame along the displacements that link it to frames with tracks.
#pragma once

#include <array>
#include <cstdint>
#include <span>
#include <vector>

#include "tracks/chained_frame.h"
#include "tracks/cosine_test.h"
#include "tracks/geometry.h"
#include "tracks/link.h"
#include "tracks/track_builder_options.h"
#include "tracks/track_store.h"

namespace colmap_av1::tracks {

// If two tracks lead to one cell, the longer one is continued. If two cells claim one track, the
// cell gets it whose centre is nearest to the track.
class Chainer {
 public:
  Chainer(const TrackBuilderOptions& options, const CellGrid& grid);

  // Continues tracks of the linked frames into the cells of the current frame, which are empty. The
  // links are followed in order.
  void chain(ChainedFrame& current, std::span<Link> links, TrackStore& store);

 private:
  // The position that a track would get by a cell's displacement, and how well it fits.
  struct Claim {
    std::int32_t cell = -1;  // in the frame that has the displacement
    float cost = 0.F;        // distance of `position` from the centre of its cell, in coded pixels
    Point position;          // in the current frame, coded pixels
    Point velocity;
    float variance = 0.F;
  };
  // The best track found for a cell so far.
  struct Found {
    int cell = -1;  // in the frame with tracks
    Claim claim;
  };
  struct OpenUnit {
    std::int32_t row = 0;
    std::int32_t col = 0;
  };
  // A cell of the current frame that searches for a track.
  struct Searcher {
    int cell = -1;
    int unit = -1;
    Point centre;
  };
  struct Window {
    int top = 0;
    int bottom = -1;  // inclusive, like right
    int left = 0;
    int right = -1;
  };
  // Which displacements a cell uses to search for tracks: its unit's, or those of neighbouring
  // units.
  enum class Reach { kOwn, kNeighbours };

  void collect_open_units(std::span<const Link> links);
  bool is_open(OpenUnit unit) const;

  void chain_backward(const Link& link);
  void chain_backward(const Link& link, int list, Reach reach);
  void collect_pending(const ChainedFrame& other);
  void mark_continued(const ChainedFrame& other, int cell);
  void collect_neighbour_motion(const Link& link, int list, int unit);
  bool may_find_track(const Link& link, int unit, const UnitMotion& motion, Reach reach) const;
  void claim_track(const Link& link, int list, Reach reach, Searcher searcher);
  Found find_track(const Link& link, const Searcher& searcher, const UnitMotion& motion,
                   Found best) const;
  bool is_better(const Claim& claim, const Claim& holder) const;
  static Window around(const Link& link, Point position, float reach);

  void chain_forward(const Link& link, int list);
  void claim_cell(const Link& link, int cell, const UnitMotion& motion);

  bool is_preferred(const ChainedFrame& frame, int cell, const Claim& claim, int other_cell,
                    const Claim& other_claim) const;
  void continue_track(ChainedFrame& other, int other_cell, int cell, const Claim& claim);

  CellGrid grid_;
  float bridge_;  // in px; 0: off
  CosineTest cosine_;

  // Set while a frame is chained.
  ChainedFrame* current_ = nullptr;
  TrackStore* store_ = nullptr;
  // Buffers that are reused for every frame.
  // By cell of the link's frame without the displacement; all empty between links.
  std::vector<Claim> claims_;
  std::vector<std::int32_t> claimed_;  // cells with a claim
  std::vector<OpenUnit> open_units_;   // of the current frame, in raster order
  // For a frame with tracks: the cells whose tracks are not yet continued into the current frame,
  // and the units that have such cells.
  std::vector<std::uint8_t> pending_;
  std::vector<std::uint8_t> pending_units_;
  // For a unit of the current frame: the motion of its neighbours that its cells use, too.
  int neighbours_of_ = -1;
  std::vector<const UnitMotion*> neighbour_motion_;
};

}  // namespace colmap_av1::tracks
