// Carries tracks into a frame along the displacements that link it to frames with tracks.
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

// Where two tracks want one cell the longer goes on; where two cells want one track, the one that
// puts it nearest to its centre has it.
class Chainer {
 public:
  Chainer(const TrackBuilderOptions& options, const CellGrid& grid);

  // Gives tracks of the linked frames their places in the current frame's cells, which are empty.
  // The links are followed in their order.
  void chain(ChainedFrame& current, std::span<Link> links, TrackStore& store);

 private:
  // What a cell would do with a track, and how well it fits.
  struct Claim {
    std::int32_t cell = -1;  // of the frame whose displacement it is
    float cost = 0.F;        // distance from the claiming cell's centre, in coded pixels
    Point position;          // in the current frame, coded pixels
    Point velocity;
    float variance = 0.F;
  };
  // The best track for a cell so far.
  struct Found {
    int cell = -1;  // of the frame with tracks
    Claim claim;
  };
  struct OpenUnit {
    std::int32_t row = 0;
    std::int32_t col = 0;
  };
  // A cell of the current frame that asks for a track.
  struct Asker {
    int cell = -1;
    int unit = -1;
    Point centre;
  };
  struct Window {
    int top = 0;
    int bottom = -1;  // included, as is right
    int left = 0;
    int right = -1;
  };
  // Whose displacements a cell looks for tracks by: its unit's, or those of the units beside.
  enum class Reach { kOwn, kBeside };

  void note_open_units(std::span<const Link> links);
  bool is_open(OpenUnit unit) const;

  void chain_backward(const Link& link);
  void chain_backward(const Link& link, int list, Reach reach);
  void note_unplaced(const ChainedFrame& other);
  void note_placed(const ChainedFrame& other, int cell);
  void note_motion_beside(const Link& link, int list, int unit);
  bool may_find_track(const Link& link, int unit, const UnitMotion& motion, Reach reach) const;
  void claim_track(const Link& link, int list, Reach reach, Asker asker);
  Found find_track(const Link& link, const Asker& asker, const UnitMotion& motion,
                   Found best) const;
  bool is_better(const Claim& claim, const Claim& holder) const;
  static Window around(const Link& link, Point position, float reach);

  void chain_forward(const Link& link, int list);
  void push_track(const Link& link, int cell, const UnitMotion& motion);

  bool is_preferred(const ChainedFrame& frame, int cell, const Claim& claim, int other_cell,
                    const Claim& other_claim) const;
  void carry_on(ChainedFrame& other, int other_cell, int cell, const Claim& claim);

  CellGrid grid_;
  float bridge_;  // in px; 0: off
  CosineTest cosine_;

  // While a frame is chained.
  ChainedFrame* current_ = nullptr;
  TrackStore* store_ = nullptr;
  // Buffers that are kept from frame to frame.
  std::vector<Claim> claims_;          // by cell, free between links
  std::vector<std::int32_t> claimed_;  // those that are not
  std::vector<OpenUnit> open_units_;   // of the current frame, in raster order
  // Of a frame with tracks: cells whose tracks have no place in the current frame yet, and units
  // that have such cells.
  std::vector<std::uint8_t> unplaced_;
  std::vector<std::uint8_t> unplaced_units_;
  // Of a unit of the current frame: the motion of those beside it that it looks for tracks by.
  int beside_unit_ = -1;
  std::vector<const UnitMotion*> beside_;
};

}  // namespace colmap_av1::tracks
