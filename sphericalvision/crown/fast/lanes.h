// SPDX-License-Identifier: Apache-2.0
// Sixteen channels as one vector: of AVX-512 in single precision, of several narrower ones elsewhere.

#pragma once

#include <cstdint>
#include <cstring>

namespace lanes {

constexpr int64_t LANES = 16;

template <typename T>
struct Lanes {
  typedef T Vector __attribute__((vector_size(LANES * sizeof(T))));
};
template <typename T>
using Vec = typename Lanes<T>::Vector;

template <typename T>
inline Vec<T> load(const T* from, const int64_t count = LANES) {
  Vec<T> value{};
  if (count >= LANES) {
    std::memcpy(&value, from, sizeof(value));
  } else {
    std::memcpy(&value, from, count * sizeof(T));
  }
  return value;
}

template <typename T>
inline void store(T* to, const Vec<T>& value, const int64_t count = LANES) {
  if (count >= LANES) {
    std::memcpy(to, &value, sizeof(value));
  } else {
    std::memcpy(to, &value, count * sizeof(T));
  }
}

}  // namespace lanes
