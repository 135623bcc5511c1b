// Bindings of the tracks core.
#pragma once

#include <nanobind/nanobind.h>

namespace colmap_av1 {

void bind_tracks(nanobind::module_& m);

}  // namespace colmap_av1
