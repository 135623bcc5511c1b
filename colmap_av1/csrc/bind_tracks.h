// Bindings of the tracks core.

#ifndef COLMAP_AV1_BIND_TRACKS_H_
#define COLMAP_AV1_BIND_TRACKS_H_

#include <nanobind/nanobind.h>

void bind_tracks(nanobind::module_& m);

#endif  // COLMAP_AV1_BIND_TRACKS_H_
