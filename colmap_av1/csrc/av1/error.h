// Errors of the parser.
#pragma once

#include <stdexcept>

namespace colmap_av1::av1 {

// The bitstream is damaged or violates the specification.
struct BitstreamError : std::runtime_error {
  using std::runtime_error::runtime_error;
};

// The stream exceeds a limit given by the options.
struct LimitError : std::runtime_error {
  using std::runtime_error::runtime_error;
};

}  // namespace colmap_av1::av1
