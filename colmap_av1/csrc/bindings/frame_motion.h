// The package's FrameMotion as the core reads it.
#pragma once

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <vector>

#include "tracks/frame_motion.h"

namespace colmap_av1 {

// Holds the arrays of a FrameMotion object. Throws nanobind::type_error for a value of another
// type, std::invalid_argument for arrays that do not fit each other.
class HeldFrameMotion {
 public:
  explicit HeldFrameMotion(nanobind::handle frame);

  const tracks::FrameMotion& operator*() const { return motion_; }

 private:
  template <typename T, typename Shape>
  const T* hold(nanobind::handle values, const char* name, const char* expected);
  void check_units(const char* name) const;
  void hold_header(nanobind::handle header);
  void hold_references(nanobind::handle frame);
  void hold_units(nanobind::handle frame);

  tracks::FrameMotion motion_;
  std::vector<nanobind::ndarray<>> held_;
};

void bind_frame_motion(nanobind::module_& m);

}  // namespace colmap_av1
