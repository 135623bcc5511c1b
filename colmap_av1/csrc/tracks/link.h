// Which frames are linked by displacements, and in which direction.
#pragma once

#include <array>
#include <memory>
#include <span>
#include <vector>

#include "tracks/chained_frame.h"
#include "tracks/dominant_motion.h"
#include "tracks/track_builder_options.h"

namespace colmap_av1::tracks {

// A frame with tracks that is linked to the frame being chained by displacements of the current
// frame's units (backward) or of the other frame's units (forward).
struct Link {
  ChainedFrame* other = nullptr;
  bool forward = false;
  std::array<bool, kNumRefs> refs{};  // the RefFrame values of the link
  int distance = 0;                   // in shown frames
  int interval = 0;                   // other minus current display index; 0 if unknown
  // Scales from pixels of the other picture to coded pixels of the current frame, and from these to
  // cells of the other frame.
  float from_picture_x = 1.F;
  float from_picture_y = 1.F;
  float to_cells_x = 1.F;
  float to_cells_y = 1.F;
  // Scale from the other picture to the current picture.
  float picture_x = 1.F;
  float picture_y = 1.F;
  // Scale from a displacement to pixels of the current picture per shown frame.
  double to_velocity_x = 0;
  double to_velocity_y = 0;
  DominantMotion dominant;  // of the displacement field; set by CosineTest
};

// Whether a frame has displacements into another one that chaining may follow.
bool leads_to(const TrustedMotion& from, const TrustedMotion& to,
              const TrackBuilderOptions& options);

// The links of the current frame to chained frames, ordered by display distance. A frame that is
// never shown has no display time and comes last.
std::vector<Link> find_links(const ChainedFrame& current,
                             std::span<const std::unique_ptr<ChainedFrame>> frames,
                             const CellGrid& grid, const TrackBuilderOptions& options);

}  // namespace colmap_av1::tracks
