// Which frames displacements link, and by whose.
#pragma once

#include <array>
#include <memory>
#include <span>
#include <vector>

#include "tracks/chained_frame.h"
#include "tracks/dominant_motion.h"
#include "tracks/track_builder_options.h"

namespace colmap_av1::tracks {

// A frame with tracks that displacements link to the frame being chained: from the current frame's
// units (backward) or from the other's (forward).
struct Link {
  ChainedFrame* other = nullptr;
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
  DominantMotion dominant;  // of the field that the displacements come from; set by CosineTest
};

// Whether displacements of a frame that chaining may follow lead to another one.
bool leads_to(const TrustedMotion& from, const TrustedMotion& to,
              const TrackBuilderOptions& options);

// The links of the current frame to chained ones, nearest in display first; a frame that is never
// shown has no place in time and comes last.
std::vector<Link> find_links(const ChainedFrame& current,
                             std::span<const std::unique_ptr<ChainedFrame>> frames,
                             const CellGrid& grid, const TrackBuilderOptions& options);

}  // namespace colmap_av1::tracks
