// Motion between blocks: within them, and where a block has none that may be trusted.
#pragma once

#include <vector>

#include "tracks/trusted_motion.h"

namespace colmap_av1::tracks {

// A block has one vector, the best for all of it; what it shows moves smoothly. Every unit is given
// the vector between the centres of its block and of the blocks beside it that move alike, across
// and down: their displacements differ by less than `limit` coded pixels. A warp already says how
// its block moves from place to place; at the border to one, its unit's displacement counts where
// that unit lies. `unfilled` is working memory kept by the caller.
void interpolate_blocks(float limit, std::vector<UnitMotion>& unfilled, TrustedMotion& motion);

// Units of a block without motion that may be trusted, such as an intra one, move as what lies on
// either side where that moves alike, across and down: each is given the motion between.
void bridge_blocks(float limit, std::vector<UnitMotion>& unfilled, TrustedMotion& motion);

}  // namespace colmap_av1::tracks
