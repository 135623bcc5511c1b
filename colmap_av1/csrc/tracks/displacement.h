// Displacement of 4x4 units into the frames they reference.
#pragma once

#include <array>
#include <optional>
#include <vector>

#include "tracks/frame_motion.h"

namespace colmap_av1::tracks {

// The displacement of one unit into a reference frame.
struct Displacement {
  int ref = 0;  // RefFrame; 0: none
  float dx = 0.F;
  float dy = 0.F;
  const av1::WarpParams* warp = nullptr;  // affine model; null for a translation
};

// The rules of 7.11.3.1 that select translation, local or global warp. Keeps a reference to the
// frame.
class DisplacementModel {
 public:
  explicit DisplacementModel(const FrameMotion& frame);

  // Displacement of the unit's centre, in pixels of the current frame.
  Displacement at(int unit, int list) const;

 private:
  const FrameMotion& frame_;
  std::array<bool, kNumRefs> global_warp_{};
};

// A position in pixels; the origin is the picture's corner.
struct Position {
  double x = 0;
  double y = 0;
};

// The position to which an affine warp model moves a position (7.11.3.5).
Position apply_warp(const av1::WarpParams& params, Position at);

// The position that apply_warp moves to `at`; nothing for a singular model.
std::optional<Position> invert_warp(const av1::WarpParams& params, Position at);

// [mi_rows, mi_cols, 2] (x, y); NaN if the list references no frame.
std::vector<float> displacement(const FrameMotion& frame, int list);

}  // namespace colmap_av1::tracks
