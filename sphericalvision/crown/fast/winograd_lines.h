// SPDX-License-Identifier: Apache-2.0
// Winograd's F(4, 3) and F(3, 3) for one line of values, as matrices: from given values to factors, from their products to
// results, and from a weight's three taps to as many factors as values have. Why these points, is in convolution.py.

#pragma once

#include <type_traits>

namespace winograd {

// F(4, 3) with the points 0, A, -A, B, -B and infinity: six given values, four results.
constexpr double A = 0.70710678118654752, B = 1.41421356237309505;
constexpr double GIVEN_6[6][6] = {
    {1, 0, -2.5, 0, 1, 0},
    {0, -2 * A, -2, A, 1, 0},
    {0, 2 * A, -2, -A, 1, 0},
    {0, -B / 2, -0.5, B, 1, 0},
    {0, B / 2, -0.5, -B, 1, 0},
    {0, 1, 0, -2.5, 0, 1},
};
constexpr double RESULTS_6[4][6] = {
    {1, 1, 1, 1, 1, 0},
    {0, A, -A, B, -B, 0},
    {0, 0.5, 0.5, 2, 2, 0},
    {0, A / 2, -A / 2, 2 * B, -2 * B, 1},
};
constexpr double TAPS_6[6][3] = {
    {1, 0, 0},
    {-2. / 3, -2 * A / 3, -1. / 3},
    {-2. / 3, 2 * A / 3, -1. / 3},
    {1. / 6, B / 6, 1. / 3},
    {1. / 6, -B / 6, 1. / 3},
    {0, 0, 1},
};

// F(3, 3) with the points 0, 1, -1, 2 and infinity: five given values, three results.
constexpr double GIVEN_5[5][5] = {{2, -1, -2, 1, 0}, {0, -2, -1, 1, 0}, {0, 2, -3, 1, 0}, {0, -1, 0, 1, 0}, {0, 2, -1, -2, 1}};
constexpr double RESULTS_5[3][5] = {{1, 1, 1, 1, 0}, {0, 1, -1, 2, 0}, {0, 1, 1, 4, 1}};
constexpr double TAPS_5[5][3] = {
    {1. / 2, 0, 0}, {-1. / 2, -1. / 2, -1. / 2}, {-1. / 6, 1. / 6, -1. / 6}, {1. / 6, 1. / 3, 2. / 3}, {0, 0, 1}};

// A matrix times a line of vectors, or, for gradients, its transpose. All is unrolled, so that zeros and ones cost nothing.
template <const auto& MATRIX, bool TRANSPOSED, typename V, int FROM, int TO>
inline void line(const V (&in)[FROM], V (&out)[TO]) {
  if constexpr (FROM == 1) {  // images have one plane, which is its own factor
    out[0] = in[0];
    return;
  }
  using T = std::remove_cvref_t<decltype(in[0][0])>;
#pragma GCC unroll 6
  for (int i = 0; i < TO; ++i) {
    bool any = false;  // the first product begins the sum: zero and a product would be an addition more
#pragma GCC unroll 6
    for (int j = 0; j < FROM; ++j) {
      const auto factor = static_cast<T>(MATRIX[TRANSPOSED ? j : i][TRANSPOSED ? i : j]);
      if (factor == 0) continue;
      out[i] = any ? out[i] + factor * in[j] : factor * in[j];
      any = true;
    }
  }
}

// The same along both sides of a square.
template <const auto& MATRIX, bool TRANSPOSED, typename V, int FROM, int TO>
inline void square(const V (&in)[FROM][FROM], V (&out)[TO][TO]) {
  V half[FROM][TO], column[FROM], turned[TO];
#pragma GCC unroll 5
  for (int i = 0; i < FROM; ++i) line<MATRIX, TRANSPOSED>(in[i], half[i]);
#pragma GCC unroll 5
  for (int j = 0; j < TO; ++j) {
#pragma GCC unroll 5
    for (int i = 0; i < FROM; ++i) column[i] = half[i][j];
    line<MATRIX, TRANSPOSED>(column, turned);
#pragma GCC unroll 5
    for (int i = 0; i < TO; ++i) out[i][j] = turned[i];
  }
}

}  // namespace winograd
