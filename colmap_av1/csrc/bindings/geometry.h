// Bindings of the geometry core.
#pragma once

#include <nanobind/nanobind.h>

namespace colmap_av1 {

void bind_geometry(nanobind::module_& m);

}  // namespace colmap_av1
