// Displacement of 4x4 units into the frames they reference.

#ifndef COLMAP_AV1_TRACKS_DISPLACEMENT_H_
#define COLMAP_AV1_TRACKS_DISPLACEMENT_H_

#include <array>
#include <cstdint>

namespace colmap_av1::tracks {

inline constexpr int kNumRefs = 8;         // RefFrame 0..7, 0 is INTRA_FRAME
inline constexpr int kNumBlockSizes = 22;  // BLOCK_4X4 .. BLOCK_64X16

// Block data of one coded frame: borrowed arrays, one entry per 4x4 luma unit in
// raster order, under the specification's names.
struct MotionField {
  int mi_rows = 0;
  int mi_cols = 0;
  int width = 0;   // FrameWidth: the units lie in the picture before super-resolution
  int height = 0;  // FrameHeight
  const int8_t* ref_frame = nullptr;  // [n][2]
  const int16_t* mv = nullptr;        // [n][list][0 = row, 1 = column], 1/8 px
  const uint8_t* mi_size = nullptr;
  const uint8_t* y_mode = nullptr;
  const uint8_t* is_inter = nullptr;
  const uint8_t* use_intrabc = nullptr;
  const uint8_t* motion_mode = nullptr;
  const uint8_t* interintra = nullptr;
  const int32_t* warp_index = nullptr;
  const int32_t* local_warp_params = nullptr;  // [num_local_warps][6]
  int num_local_warps = 0;
  const int32_t* gm_type = nullptr;    // [7], LAST..ALTREF
  const int32_t* gm_params = nullptr;  // [7][6]
  const int32_t* ref_size = nullptr;   // [8][2] (width, height)
  bool force_integer_mv = false;

  int num_units() const { return mi_rows * mi_cols; }
};

// Where one unit's content lies in a reference frame.
struct Displacement {
  int ref = 0;  // RefFrame, 0: none
  float dx = 0.F;
  float dy = 0.F;
  const int32_t* warp = nullptr;  // affine model in force, null for a translation
};

// Throws std::invalid_argument for a size that no frame has or that the units do not cover, and
// where a unit's value would index outside a table.
void check_motion_field(const MotionField& field);

// The rules of 7.11.3.1 that choose between translation, local and global warp.
class DisplacementModel {
 public:
  explicit DisplacementModel(const MotionField& field);

  // Displacement of the unit's centre, in pixels of the current frame.
  Displacement at(int unit, int list) const;

 private:
  MotionField field_;
  std::array<bool, kNumRefs> global_warp_{};
};

// Position (x, y), corner origin, under an affine warp model (7.11.3.5).
void apply_warp(const int32_t* params, double x, double y, double* out_x, double* out_y);

// The position that apply_warp takes to (x, y). False for a singular model.
bool invert_warp(const int32_t* params, double x, double y, double* out_x, double* out_y);

// Writes float [mi_rows, mi_cols, 2] (x, y), NaN where the list references no frame.
void displacement(const MotionField& field, int list, float* out);

}  // namespace colmap_av1::tracks

#endif  // COLMAP_AV1_TRACKS_DISPLACEMENT_H_
