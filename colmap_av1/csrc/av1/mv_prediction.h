// Motion vector prediction (specification section 7.10).
#pragma once

#include <array>

#include "av1/frame_state.h"
#include "av1/warp.h"

namespace colmap_av1::av1 {

// Result of the find MV stack process: predicted vectors, and contexts for the next symbols.
struct MvStack {
  struct Entry {
    std::array<Mv, 2> mv;  // RefStackMv
    int weight;            // WeightStack
  };
  std::array<Entry, MAX_REF_MV_STACK_SIZE + 2> entries{};
  int num_mv_found = 0;
  std::array<Mv, 2> global_mvs{};
  int new_mv_context = 0;
  int ref_mv_context = 0;
  int zero_mv_context = 0;
  std::array<int, MAX_REF_MV_STACK_SIZE + 2> drl_context{};
};

// 7.10.2 Find MV stack process, for a block whose position, size and reference frames are known
MvStack find_mv_stack(const FrameContext& frame, const TileBounds& tile, const BlockInfo& block);

// 7.10.3 Has overlappable candidates process. The blocks above and to the left are null if AvailU
// and AvailL are 0.
bool has_overlappable_candidates(const FrameContext& frame, const BlockInfo& block,
                                 const BlockInfo* above, const BlockInfo* left);

// CandList and NumSamples
struct WarpSamples {
  std::array<WarpSample, LEAST_SQUARES_SAMPLES_MAX> samples{};
  int count = 0;
};

// 7.10.4 Find warp samples process, for a block whose vector is known
WarpSamples find_warp_samples(const FrameContext& frame, const TileBounds& tile,
                              const BlockInfo& block, const BlockInfo* above,
                              const BlockInfo* left);

}  // namespace colmap_av1::av1
