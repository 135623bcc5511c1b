// Motion field estimation (specification section 7.9) and storage (7.19).
#pragma once

#include <array>
#include <vector>

#include "av1/frame_state.h"

namespace colmap_av1::av1 {

// 7.9.3 Get MV projection process
Mv project_mv(Mv mv, int numerator, int denominator);

// 7.9 Motion field estimation process. `references` by RefFrame; entry 0 is not used.
void estimate_motion_field(const SequenceHeader& seq, const FrameHeader& header,
                           const std::array<const FrameState*, TOTAL_REFS_PER_FRAME>& references,
                           std::vector<MotionFieldEntry>& motion_field);

// 7.19 Motion field motion vector storage process
void save_motion(const SequenceHeader& seq, FrameContext& frame,
                 std::vector<SavedMotion>& saved_motion);

}  // namespace colmap_av1::av1
