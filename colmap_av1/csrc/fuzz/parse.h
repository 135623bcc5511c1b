// Parsing of temporal units in the fuzzers.
#pragma once

#include <cstddef>
#include <cstdint>
#include <memory>
#include <span>
#include <utility>
#include <vector>

#include "av1/error.h"
#include "av1/parser.h"

namespace colmap_av1::fuzz {

// Parses data and calls `take` with each event; false if the data are damaged or declare a frame
// that is too large.
template <typename Take>
bool parse(av1::Parser& parser, std::span<const std::uint8_t> data, const Take& take) {
  // A copy, so that a read past the data is a read past an allocation.
  const std::vector<std::uint8_t> copy(data.begin(), data.end());
  try {
    for (std::size_t position = 0; position < copy.size();) {
      if (auto event = parser.parse(copy, position)) take(std::move(event));
    }
  } catch (const av1::BitstreamError&) {
    return false;
  } catch (const av1::LimitError&) {
    return false;
  }
  return true;
}

}  // namespace colmap_av1::fuzz
