// Displacement of 4x4 units into the frames they reference.
#pragma once

#include <array>
#include <cstdint>

#include "tracks/frame_motion.h"

namespace colmap_av1::tracks {

// Where one unit's content lies in a reference frame.
struct Displacement {
  int ref = 0;  // RefFrame, 0: none
  float dx = 0.F;
  float dy = 0.F;
  const std::int32_t* warp = nullptr;  // affine model in force, null for a translation
};

// The rules of 7.11.3.1 that choose between translation, local and global warp.
class DisplacementModel {
 public:
  explicit DisplacementModel(const FrameMotion& frame);

  // Displacement of the unit's centre, in pixels of the current frame.
  Displacement at(int unit, int list) const;

 private:
  FrameMotion frame_;
  std::array<bool, kNumRefs> global_warp_{};
};

// Position (x, y), corner origin, under an affine warp model (7.11.3.5).
void apply_warp(const std::int32_t* params, double x, double y, double* out_x, double* out_y);

// The position that apply_warp takes to (x, y). False for a singular model.
bool invert_warp(const std::int32_t* params, double x, double y, double* out_x, double* out_y);

// Writes float [mi_rows, mi_cols, 2] (x, y), NaN where the list references no frame.
void displacement(const FrameMotion& frame, int list, float* out);

}  // namespace colmap_av1::tracks
