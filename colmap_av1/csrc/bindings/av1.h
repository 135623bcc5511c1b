// Python bindings of the AV1 parser.
#pragma once

#include <nanobind/nanobind.h>

namespace colmap_av1 {

void bind_av1(nanobind::module_& m);

}  // namespace colmap_av1
