// Bindings of the model core.
#pragma once

#include <nanobind/nanobind.h>

namespace colmap_av1 {

void bind_model(nanobind::module_& m);

}  // namespace colmap_av1
