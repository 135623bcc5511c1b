// Warp models of blocks (specification sections 7.11.3.6 and 7.11.3.8).
#pragma once

#include <span>

#include "av1/frame_state.h"

namespace colmap_av1::av1 {

// An entry of CandList: positions in this frame and in the reference, in 1/8 luma samples
struct WarpSample {
  int row = 0;
  int col = 0;
  int ref_row = 0;
  int ref_col = 0;
};

// 7.11.3.6 Setup shear process: warpValid
bool warp_valid(const WarpParams& warp_params);

// 7.11.3.8 Warp estimation process, and the shear check of 7.11.3.1
LocalWarp estimate_local_warp(const BlockInfo& block, std::span<const WarpSample> samples);

}  // namespace colmap_av1::av1
