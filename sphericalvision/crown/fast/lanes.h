// SPDX-License-Identifier: Apache-2.0
// As many channels as one register of the processor holds in single precision: one vector.
//
// A vector that is wider than a register has no machine mode: GCC keeps it in memory, and every sum of products then waits
// for a store and a load. So the width follows the instruction set. (Double precision, which serves to check gradients,
// takes two registers a vector and is slow.)

#pragma once

#include <cstdint>
#include <cstring>

#if defined(__AVX512F__)
#include <immintrin.h>
#endif

namespace lanes {

#if defined(__AVX512F__)
constexpr int64_t LANES = 16;
#elif defined(__AVX2__)
constexpr int64_t LANES = 8;
#else
constexpr int64_t LANES = 4;
#endif

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
    return value;
  }
#if defined(__AVX512F__)  // a mask is one instruction, where the library's function is a call
  if constexpr (sizeof(T) == 4) return (Vec<T>)_mm512_maskz_loadu_ps((1u << count) - 1, from);
#endif
  std::memcpy(&value, from, count * sizeof(T));
  return value;
}

template <typename T>
inline void store(T* to, const Vec<T>& value, const int64_t count = LANES) {
  if (count >= LANES) {
    std::memcpy(to, &value, sizeof(value));
    return;
  }
#if defined(__AVX512F__)
  if constexpr (sizeof(T) == 4) return _mm512_mask_storeu_ps(to, (1u << count) - 1, (__m512)value);
#endif
  std::memcpy(to, &value, count * sizeof(T));
}

// The ReLU; NaN stays.
template <typename T>
inline Vec<T> rectified(const Vec<T>& value) {
  return value < Vec<T>{} ? Vec<T>{} : value;
}

}  // namespace lanes
