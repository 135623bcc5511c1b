// A single affine motion of a whole frame, from a camera that stands still or moves along a flat
// surface.
#pragma once

#include <span>

#include "tracks/dominant_motion.h"

namespace colmap_av1::tracks {

// The displacement of a unit, and the number of shown frames that it spans; negative: into the
// past.
struct TimedMotion {
  MotionSample sample;
  int interval = 0;
};

// The single affine motion of a frame. Encoders code such frames in their largest blocks. In other
// frames large blocks are not trusted, because they show plain surfaces that any vector predicts.
class AffineMotion {
 public:
  // `spread` are moving units that are spread over the whole picture. If fewer than nine in ten of
  // them agree with a single affine motion, nothing agrees.
  AffineMotion(std::span<const TimedMotion> spread, double width, double height);

  bool agrees(const TimedMotion& motion) const;

 private:
  bool fits(const TimedMotion& motion) const;

  DominantMotion velocity_;  // px per shown frame
  bool is_common_ = false;
};

}  // namespace colmap_av1::tracks
