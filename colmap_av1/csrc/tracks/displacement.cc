#include "tracks/displacement.h"

#include <algorithm>
#include <cmath>
#include <limits>

#include "av1/constants.h"
#include "av1/spec_tables.h"
#include "av1/warp.h"

namespace colmap_av1::tracks {
namespace {

constexpr double kWarpOne = 1 << av1::WARPEDMODEL_PREC_BITS;

bool is_valid_warp(const std::int32_t* params) {
  // A model that mirrors or collapses x has no shear factors.
  if (params[2] <= 0) return false;
  std::array<std::int32_t, 6> copy;
  std::copy_n(params, copy.size(), copy.begin());
  return av1::warp_valid(copy);
}

}  // namespace

DisplacementModel::DisplacementModel(const FrameMotion& frame) : frame_(frame) {
  for (int ref = 1; ref < kNumRefs; ++ref) {
    const std::int32_t ref_width = frame.ref_size[2 * ref];
    const std::int32_t ref_height = frame.ref_size[2 * ref + 1];
    const bool scaled =
        ref_width > 0 && (ref_width != frame.frame_width || ref_height != frame.height);
    global_warp_[ref] = !frame.force_integer_mv && !scaled &&
                        frame.gm_type[ref - 1] > av1::TRANSLATION &&
                        is_valid_warp(frame.gm_params + 6 * (ref - 1));
  }
}

Displacement DisplacementModel::at(int unit, int list) const {
  Displacement result;
  const int ref = frame_.ref_frame[2 * unit + list];
  if (ref <= 0 || frame_.is_inter[unit] == 0 || frame_.use_intrabc[unit] != 0 ||
      (list == 1 && frame_.interintra[unit] != 0)) {
    return result;
  }
  result.ref = ref;
  const int size = frame_.mi_size[unit];
  const bool large = std::min(av1::kBlockWidth[size], av1::kBlockHeight[size]) >= 8;
  if (large && frame_.motion_mode[unit] == av1::LOCALWARP && frame_.warp_index[unit] >= 0) {
    result.warp = frame_.local_warp_params + 6 * std::ptrdiff_t{frame_.warp_index[unit]};
  } else if (large && global_warp_[ref] &&
             (frame_.y_mode[unit] == av1::GLOBALMV ||
              frame_.y_mode[unit] == av1::GLOBAL_GLOBALMV)) {
    result.warp = frame_.gm_params + 6 * (ref - 1);
  }
  if (result.warp == nullptr) {
    const std::int16_t* mv = frame_.mv + 4 * std::ptrdiff_t{unit} + 2 * list;
    result.dx = static_cast<float>(mv[1]) / 8.F;
    result.dy = static_cast<float>(mv[0]) / 8.F;
    return result;
  }
  const double x = 4 * (unit % frame_.mi_cols) + 2;
  const double y = 4 * (unit / frame_.mi_cols) + 2;
  double target_x = 0;
  double target_y = 0;
  apply_warp(result.warp, x, y, &target_x, &target_y);
  result.dx = static_cast<float>(target_x - x);
  result.dy = static_cast<float>(target_y - y);
  return result;
}

// The specification's coordinates are zero at the first sample's centre, ours at its
// corner: half a pixel goes off before and on after.
void apply_warp(const std::int32_t* params, double x, double y, double* out_x, double* out_y) {
  const double sx = x - 0.5;
  const double sy = y - 0.5;
  *out_x = (params[2] * sx + params[3] * sy + params[0]) / kWarpOne + 0.5;
  *out_y = (params[4] * sx + params[5] * sy + params[1]) / kWarpOne + 0.5;
}

bool invert_warp(const std::int32_t* params, double x, double y, double* out_x, double* out_y) {
  const double a = params[2];
  const double b = params[3];
  const double c = params[4];
  const double d = params[5];
  const double determinant = a * d - b * c;
  if (std::abs(determinant) < 1e-3 * kWarpOne * kWarpOne) return false;
  const double tx = (x - 0.5) * kWarpOne - params[0];
  const double ty = (y - 0.5) * kWarpOne - params[1];
  *out_x = (d * tx - b * ty) / determinant + 0.5;
  *out_y = (a * ty - c * tx) / determinant + 0.5;
  return true;
}

void displacement(const FrameMotion& frame, int list, float* out) {
  const DisplacementModel model(frame);
  const int n = frame.num_units();
  for (int u = 0; u < n; ++u) {
    const Displacement d = model.at(u, list);
    const bool valid = d.ref > 0;
    constexpr float kNan = std::numeric_limits<float>::quiet_NaN();
    out[2 * std::ptrdiff_t{u}] = valid ? d.dx : kNan;
    out[2 * std::ptrdiff_t{u} + 1] = valid ? d.dy : kNan;
  }
}

}  // namespace colmap_av1::tracks
