// Converts the package's FrameMotion for the core.
#pragma once

#include <nanobind/nanobind.h>

#include <optional>

#include "bindings/arrays.h"
#include "bindings/buffer.h"
#include "tracks/frame_motion.h"

namespace colmap_av1 {

// Holds the arrays of a FrameMotion object. Throws nanobind::type_error for a value of a wrong
// type, and std::invalid_argument for inconsistent arrays.
class HeldFrameMotion {
 public:
  explicit HeldFrameMotion(nanobind::handle frame);

  const tracks::FrameMotion& operator*() const { return motion_; }

 private:
  void hold_blocks(nanobind::handle frame);

  tracks::FrameMotion motion_;
  std::optional<Buffer> blocks_;
  InputArray<std::int32_t, nanobind::ndim<2>> block_index_;
  InputArray<std::int32_t, nanobind::shape<-1, 6>> local_warp_params_;
};

void bind_frame_motion(nanobind::module_& m);

}  // namespace colmap_av1
