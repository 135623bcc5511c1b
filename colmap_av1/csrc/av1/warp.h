// Warp models of blocks (specification sections 7.11.3.6 and 7.11.3.8).
#pragma once

#include <array>
#include <cstdint>

#include "av1/frame_state.h"

namespace colmap_av1::av1 {

// CandList of the find warp samples process: position (row, column) in this frame and in the
// reference, in 1/8 luma samples.
using WarpSamples = std::array<std::array<int, 4>, LEAST_SQUARES_SAMPLES_MAX>;

// 7.11.3.6 Setup shear process: warpValid
bool warp_valid(const std::array<std::int32_t, 6>& warp_params);

// 7.11.3.8 Warp estimation process, and the check of the shear that 7.11.3.1 adds
LocalWarp estimate_local_warp(int mi_row, int mi_col, int mi_size, Mv mv,
                              const WarpSamples& samples, int num_samples);

}  // namespace colmap_av1::av1
