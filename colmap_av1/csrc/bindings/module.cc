// Python bindings of the core; only this folder knows Python.
#include <nanobind/nanobind.h>

#include "bindings/av1.h"
#include "bindings/frame_motion.h"
#include "bindings/geometry.h"
#include "bindings/tracks.h"

NB_MODULE(_core, m) {
  m.doc() = "AV1 motion parser, track builder and triangulation";
  colmap_av1::bind_av1(m);
  colmap_av1::bind_frame_motion(m);
  colmap_av1::bind_tracks(m);
  colmap_av1::bind_geometry(m);
}
