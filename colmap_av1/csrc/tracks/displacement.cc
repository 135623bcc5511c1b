#include "tracks/displacement.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <stdexcept>

#include "av1/constants.h"
#include "av1/spec_tables.h"
#include "av1/warp.h"

namespace colmap_av1::tracks {
namespace {

constexpr int kMaxSide = 65536;  // a frame header has 16 bits for a size less one
constexpr double kWarpOne = 1 << av1::WARPEDMODEL_PREC_BITS;

bool is_valid_warp(const int32_t* params) {
  // A model that mirrors or collapses x has no shear factors.
  if (params[2] <= 0) return false;
  std::array<int32_t, 6> copy;
  std::copy_n(params, copy.size(), copy.begin());
  return av1::warp_valid(copy);
}

}  // namespace

void check_motion_field(const MotionField& field) {
  if (field.width < 1 || field.width > kMaxSide || field.height < 1 || field.height > kMaxSide) {
    throw std::invalid_argument("a frame's width and height are 1 to 65536 pixels");
  }
  if (field.width > 4 * field.mi_cols || field.height > 4 * field.mi_rows) {
    throw std::invalid_argument("the picture is larger than its 4x4 units cover");
  }
  const int n = field.num_units();
  for (int u = 0; u < n; ++u) {
    if (field.mi_size[u] >= kNumBlockSizes) {
      throw std::invalid_argument("mi_size holds a value above 21 (BLOCK_64X16)");
    }
    if (field.ref_frame[2 * u] >= kNumRefs || field.ref_frame[2 * u + 1] >= kNumRefs) {
      throw std::invalid_argument("ref_frame holds a value above 7 (ALTREF_FRAME)");
    }
    if (field.warp_index[u] >= field.num_local_warps) {
      throw std::invalid_argument("warp_index points past the rows of local_warp_params");
    }
  }
}

DisplacementModel::DisplacementModel(const MotionField& field) : field_(field) {
  for (int ref = 1; ref < kNumRefs; ++ref) {
    const int32_t ref_width = field.ref_size[2 * ref];
    const int32_t ref_height = field.ref_size[2 * ref + 1];
    const bool scaled = ref_width > 0 && (ref_width != field.width || ref_height != field.height);
    global_warp_[ref] = !field.force_integer_mv && !scaled &&
                        field.gm_type[ref - 1] > av1::TRANSLATION &&
                        is_valid_warp(field.gm_params + 6 * (ref - 1));
  }
}

Displacement DisplacementModel::at(int unit, int list) const {
  Displacement result;
  const int ref = field_.ref_frame[2 * unit + list];
  if (ref <= 0 || field_.is_inter[unit] == 0 || field_.use_intrabc[unit] != 0 ||
      (list == 1 && field_.interintra[unit] != 0)) {
    return result;
  }
  result.ref = ref;
  const int size = field_.mi_size[unit];
  const bool large = std::min(av1::kBlockWidth[size], av1::kBlockHeight[size]) >= 8;
  if (large && field_.motion_mode[unit] == av1::LOCALWARP && field_.warp_index[unit] >= 0) {
    result.warp = field_.local_warp_params + 6 * std::ptrdiff_t{field_.warp_index[unit]};
  } else if (large && global_warp_[ref] &&
             (field_.y_mode[unit] == av1::GLOBALMV ||
              field_.y_mode[unit] == av1::GLOBAL_GLOBALMV)) {
    result.warp = field_.gm_params + 6 * (ref - 1);
  }
  if (result.warp == nullptr) {
    const int16_t* mv = field_.mv + 4 * std::ptrdiff_t{unit} + 2 * list;
    result.dx = static_cast<float>(mv[1]) / 8.F;
    result.dy = static_cast<float>(mv[0]) / 8.F;
    return result;
  }
  const double x = 4 * (unit % field_.mi_cols) + 2;
  const double y = 4 * (unit / field_.mi_cols) + 2;
  double target_x = 0;
  double target_y = 0;
  apply_warp(result.warp, x, y, &target_x, &target_y);
  result.dx = static_cast<float>(target_x - x);
  result.dy = static_cast<float>(target_y - y);
  return result;
}

// The specification's coordinates are zero at the first sample's centre, ours at its
// corner: half a pixel goes off before and on after.
void apply_warp(const int32_t* params, double x, double y, double* out_x, double* out_y) {
  const double sx = x - 0.5;
  const double sy = y - 0.5;
  *out_x = (params[2] * sx + params[3] * sy + params[0]) / kWarpOne + 0.5;
  *out_y = (params[4] * sx + params[5] * sy + params[1]) / kWarpOne + 0.5;
}

bool invert_warp(const int32_t* params, double x, double y, double* out_x, double* out_y) {
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

void displacement(const MotionField& field, int list, float* out) {
  const DisplacementModel model(field);
  const int n = field.num_units();
  for (int u = 0; u < n; ++u) {
    const Displacement d = model.at(u, list);
    const bool valid = d.ref > 0;
    constexpr float kNan = std::numeric_limits<float>::quiet_NaN();
    out[2 * std::ptrdiff_t{u}] = valid ? d.dx : kNan;
    out[2 * std::ptrdiff_t{u} + 1] = valid ? d.dy : kNan;
  }
}

}  // namespace colmap_av1::tracks
