#include "tracks/displacement.h"

#include <cmath>
#include <limits>

#include "av1/constants.h"
#include "av1/warp.h"

namespace colmap_av1::tracks {
namespace {

constexpr double kWarpOne = 1 << av1::WARPEDMODEL_PREC_BITS;

}  // namespace

DisplacementModel::DisplacementModel(const FrameMotion& frame) : frame_(frame) {
  for (int ref = 1; ref < kNumRefs; ++ref) {
    const auto [ref_width, ref_height] = frame.ref_size[ref];
    const bool scaled =
        ref_width > 0 && (ref_width != frame.frame_width || ref_height != frame.height);
    global_warp_[ref] = !frame.force_integer_mv && !scaled &&
                        frame.gm_type[ref] > av1::TRANSLATION &&
                        av1::warp_valid(frame.gm_params[ref]);
  }
}

Displacement DisplacementModel::at(int unit, int list) const {
  Displacement result;
  const av1::BlockInfo& block = frame_.block(unit);
  const int ref = block.ref_frame[list];
  if (ref <= 0 || block.is_inter == 0 || block.use_intrabc != 0 ||
      (list == 1 && block.interintra != 0)) {
    return result;
  }
  result.ref = ref;
  const bool large = block.is_at_least_8x8();
  if (large && block.motion_mode == av1::LOCALWARP && block.warp_index >= 0) {
    result.warp = &frame_.local_warp_params[static_cast<std::size_t>(block.warp_index)];
  } else if (large && global_warp_[ref] &&
             (block.y_mode == av1::GLOBALMV || block.y_mode == av1::GLOBAL_GLOBALMV)) {
    result.warp = &frame_.gm_params[ref];
  }
  if (result.warp == nullptr) {
    const av1::Mv mv = block.mv[list];
    result.dx = static_cast<float>(mv.col) / 8.F;
    result.dy = static_cast<float>(mv.row) / 8.F;
    return result;
  }
  const double x = 4 * (unit % frame_.mi_cols) + 2;
  const double y = 4 * (unit / frame_.mi_cols) + 2;
  const Position target = apply_warp(*result.warp, {x, y});
  result.dx = static_cast<float>(target.x - x);
  result.dy = static_cast<float>(target.y - y);
  return result;
}

// In the specification the origin is the centre of the first sample, here it is its corner. Half a
// pixel is therefore subtracted before and added after.
Position apply_warp(const av1::WarpParams& params, Position at) {
  const double x = at.x - 0.5;
  const double y = at.y - 0.5;
  return {(params[2] * x + params[3] * y + params[0]) / kWarpOne + 0.5,
          (params[4] * x + params[5] * y + params[1]) / kWarpOne + 0.5};
}

std::optional<Position> invert_warp(const av1::WarpParams& params, Position at) {
  const double a = params[2];
  const double b = params[3];
  const double c = params[4];
  const double d = params[5];
  const double determinant = a * d - b * c;
  if (std::abs(determinant) < 1e-3 * kWarpOne * kWarpOne) return std::nullopt;
  const double x = (at.x - 0.5) * kWarpOne - params[0];
  const double y = (at.y - 0.5) * kWarpOne - params[1];
  return Position{(d * x - b * y) / determinant + 0.5, (a * y - c * x) / determinant + 0.5};
}

std::vector<float> displacement(const FrameMotion& frame, int list) {
  const DisplacementModel model(frame);
  std::vector<float> out;
  out.reserve(2 * static_cast<std::size_t>(frame.num_units()));
  for (int unit = 0; unit < frame.num_units(); ++unit) {
    const Displacement d = model.at(unit, list);
    constexpr float kNan = std::numeric_limits<float>::quiet_NaN();
    out.push_back(d.ref > 0 ? d.dx : kNan);
    out.push_back(d.ref > 0 ? d.dy : kNan);
  }
  return out;
}

}  // namespace colmap_av1::tracks
