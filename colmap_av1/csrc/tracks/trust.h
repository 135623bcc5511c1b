// Expected errors of the bitstream's motion.
#pragma once

namespace colmap_av1::tracks {

// Properties of one displacement of a 4x4 unit that the bitstream gives.
struct StepTraits {
  int block_area = 16;  // px^2
  int y_mode = 0;
  bool has_residual = false;
  bool warped = false;
  bool overlapped = false;  // OBMC
  float length = 0.F;       // of the displacement, px
  // Mean distance in px to the displacements of the units around the block; negative if there are
  // none.
  float disagreement = -1.F;
};

// Expected standard deviation, in pixels along either axis, of a point that is moved by the
// displacement.
float step_sigma(const StepTraits& traits);

}  // namespace colmap_av1::tracks
