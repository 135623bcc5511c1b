// Passes arrays to and from NumPy without copying.
#pragma once

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <cstddef>
#include <initializer_list>
#include <utility>
#include <vector>

namespace colmap_av1 {

// An array that the core reads.
template <typename T, typename Shape>
using InputArray = nanobind::ndarray<const T, Shape, nanobind::c_contig, nanobind::device::cpu>;

// Transfers the memory of a vector to NumPy.
template <typename T, typename U, typename A>
nanobind::object adopt(std::vector<U, A>&& data, std::initializer_list<std::size_t> shape) {
  static_assert(sizeof(U) % sizeof(T) == 0);
  using Vector = std::vector<U, A>;
  auto* owner = new Vector(std::move(data));
  nanobind::capsule capsule(owner, [](void* p) noexcept { delete static_cast<Vector*>(p); });
  return nanobind::cast(
      nanobind::ndarray<nanobind::numpy, T>(reinterpret_cast<T*>(owner->data()), shape, capsule));
}

template <typename T>
nanobind::object adopt(std::vector<T>&& data) {
  const std::size_t size = data.size();
  return adopt<T>(std::move(data), {size});
}

}  // namespace colmap_av1
