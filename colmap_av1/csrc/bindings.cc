// Python bindings of the core; the only files that know Python are this one and bind_*.cc.
#include <nanobind/nanobind.h>

#include "bind_av1.h"
#include "bind_tracks.h"

NB_MODULE(_core, m) {
  m.doc() = "AV1 motion parser and track builder";
  colmap_av1::bind_av1(m);
  bind_tracks(m);
}
