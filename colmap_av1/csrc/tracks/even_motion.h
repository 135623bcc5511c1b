// Frames that move evenly: of a camera that stands still, or passes something flat.
#pragma once

#include <span>

#include "tracks/dominant_motion.h"

namespace colmap_av1::tracks {

// A unit's displacement, and the shown frames to that it leads to, negative into the past.
struct TimedMotion {
  MotionSample sample;
  int interval = 0;
};

// The one motion of a frame. Encoders code such frames in their largest blocks, which elsewhere are
// plain surfaces that any vector predicts, and so not trusted.
class EvenMotion {
 public:
  // `spread` are units all over the picture: those that move. Of a picture in which fewer than
  // nine in ten of them move as one affine motion says, nothing agrees.
  EvenMotion(std::span<const TimedMotion> spread, double width, double height);

  bool agrees(const TimedMotion& motion) const;

 private:
  bool fits(const TimedMotion& motion) const;

  DominantMotion velocity_;  // px per shown frame
  bool is_even_ = false;
};

}  // namespace colmap_av1::tracks
