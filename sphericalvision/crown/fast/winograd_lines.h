// SPDX-License-Identifier: Apache-2.0
// Winograd's F(4, 3) for one line of values: six given ones d become six factors, six products m four results y; and F(3, 3):
// five given ones become five factors, five products three results. A weight's three taps g become as many factors as values
// do. Those that end in _adjoint are for gradients. Why these points, is in convolution.py.

#pragma once

namespace winograd {

// The points are 0, A, -A, B, -B and infinity. T is the precision, V is T or a vector of several.
template <typename T>
constexpr T A = static_cast<T>(0.70710678118654752);
template <typename T>
constexpr T B = static_cast<T>(1.41421356237309505);
template <typename T>
constexpr T HALF = static_cast<T>(0.5);
template <typename T>
constexpr T FIVE_HALVES = static_cast<T>(2.5);

template <typename T>
constexpr T THIRD = static_cast<T>(1. / 3);
template <typename T>
constexpr T SIXTH = static_cast<T>(1. / 6);

// Three taps to six factors.
template <typename T, typename V>
inline void taps_to_factors(const V (&g)[3], V (&x)[6]) {
  const V even_a = -2 * THIRD<T> * g[0] - THIRD<T> * g[2], odd_a = -2 * THIRD<T> * A<T> * g[1];
  const V even_b = SIXTH<T> * g[0] + THIRD<T> * g[2], odd_b = SIXTH<T> * B<T> * g[1];
  x[0] = g[0];
  x[1] = even_a + odd_a;
  x[2] = even_a - odd_a;
  x[3] = even_b + odd_b;
  x[4] = even_b - odd_b;
  x[5] = g[2];
}

template <typename T, typename V>
inline void taps_to_factors_adjoint(const V (&x)[6], V (&g)[3]) {
  const V sum_a = x[1] + x[2], sum_b = x[3] + x[4];
  g[0] = x[0] - 2 * THIRD<T> * sum_a + SIXTH<T> * sum_b;
  g[1] = SIXTH<T> * B<T> * (x[3] - x[4]) - 2 * THIRD<T> * A<T> * (x[1] - x[2]);
  g[2] = THIRD<T> * (sum_b - sum_a) + x[5];
}

// Six values that are given to as many factors.
template <typename T, typename V>
inline void to_factors(const V (&d)[6], V (&x)[6]) {
  const V even_a = d[4] - 2 * d[2], odd_a = A<T> * (d[3] - 2 * d[1]);
  const V even_b = d[4] - HALF<T> * d[2], odd_b = B<T> * (d[3] - HALF<T> * d[1]);
  x[0] = d[0] - FIVE_HALVES<T> * d[2] + d[4];
  x[1] = even_a + odd_a;
  x[2] = even_a - odd_a;
  x[3] = even_b + odd_b;
  x[4] = even_b - odd_b;
  x[5] = d[1] - FIVE_HALVES<T> * d[3] + d[5];
}

template <typename T, typename V>
inline void to_factors_adjoint(const V (&x)[6], V (&d)[6]) {
  const V sum_a = x[1] + x[2], odd_a = A<T> * (x[1] - x[2]), sum_b = x[3] + x[4], odd_b = B<T> * (x[3] - x[4]);
  d[0] = x[0];
  d[1] = x[5] - 2 * odd_a - HALF<T> * odd_b;
  d[2] = -FIVE_HALVES<T> * x[0] - 2 * sum_a - HALF<T> * sum_b;
  d[3] = odd_a + odd_b - FIVE_HALVES<T> * x[5];
  d[4] = x[0] + sum_a + sum_b;
  d[5] = x[5];
}

// Six products to four results.
template <typename T, typename V>
inline void to_results(const V (&m)[6], V (&y)[4]) {
  const V sum_a = m[1] + m[2], odd_a = A<T> * (m[1] - m[2]), sum_b = m[3] + m[4], odd_b = B<T> * (m[3] - m[4]);
  y[0] = m[0] + sum_a + sum_b;
  y[1] = odd_a + odd_b;
  y[2] = HALF<T> * sum_a + 2 * sum_b;
  y[3] = HALF<T> * odd_a + 2 * odd_b + m[5];
}

template <typename T, typename V>
inline void to_results_adjoint(const V (&y)[4], V (&m)[6]) {
  const V even_a = y[0] + HALF<T> * y[2], odd_a = A<T> * (y[1] + HALF<T> * y[3]);
  const V even_b = y[0] + 2 * y[2], odd_b = B<T> * (y[1] + 2 * y[3]);
  m[0] = y[0];
  m[1] = even_a + odd_a;
  m[2] = even_a - odd_a;
  m[3] = even_b + odd_b;
  m[4] = even_b - odd_b;
  m[5] = y[3];
}

// Images have one plane, which is its own factor.
template <typename T, typename V>
inline void to_factors(const V (&d)[1], V (&x)[1]) { x[0] = d[0]; }
template <typename T, typename V>
inline void to_factors_adjoint(const V (&x)[1], V (&d)[1]) { d[0] = x[0]; }
template <typename T, typename V>
inline void to_results(const V (&m)[1], V (&y)[1]) { y[0] = m[0]; }
template <typename T, typename V>
inline void to_results_adjoint(const V (&y)[1], V (&m)[1]) { m[0] = y[0]; }
template <typename T, typename V>
inline void taps_to_factors(const V (&g)[1], V (&x)[1]) { x[0] = g[0]; }
template <typename T, typename V>
inline void taps_to_factors_adjoint(const V (&x)[1], V (&g)[1]) { g[0] = x[0]; }

// F(3, 3) with the points 0, 1, -1, 2 and infinity.
template <typename V>
inline void taps_to_factors(const V (&g)[3], V (&x)[5]) {
  const V ends = g[0] + g[2];
  x[0] = g[0] / 2;
  x[1] = -(ends + g[1]) / 2;
  x[2] = (g[1] - ends) / 6;
  x[3] = (g[0] + 2 * g[1] + 4 * g[2]) / 6;
  x[4] = g[2];
}

template <typename V>
inline void taps_to_factors_adjoint(const V (&x)[5], V (&g)[3]) {
  const V half = x[1] / 2, minus = x[2] / 6, two = x[3] / 6;
  g[0] = x[0] / 2 - half - minus + two;
  g[1] = minus - half + 2 * two;
  g[2] = 4 * two - half - minus + x[4];
}

template <typename V>
inline void to_factors(const V (&d)[5], V (&x)[5]) {
  const V odd = d[1] - d[3];
  x[0] = 2 * (d[0] - d[2]) - odd;
  x[1] = d[3] - d[2] - 2 * d[1];
  x[2] = d[3] - 3 * d[2] + 2 * d[1];
  x[3] = -odd;
  x[4] = d[4] - d[2] + 2 * odd;
}

template <typename V>
inline void to_factors_adjoint(const V (&x)[5], V (&d)[5]) {
  const V odd = 2 * (x[4] - x[1] + x[2]) - x[0] - x[3];
  d[0] = 2 * x[0];
  d[1] = odd;
  d[2] = -2 * x[0] - x[1] - 3 * x[2] - x[4];
  d[3] = 3 * x[2] - x[1] - odd;
  d[4] = x[4];
}

template <typename V>
inline void to_results(const V (&m)[5], V (&y)[3]) {
  const V sum = m[1] + m[2];
  y[0] = m[0] + sum + m[3];
  y[1] = m[1] - m[2] + 2 * m[3];
  y[2] = sum + 4 * m[3] + m[4];
}

template <typename V>
inline void to_results_adjoint(const V (&y)[3], V (&m)[5]) {
  const V even = y[0] + y[2];
  m[0] = y[0];
  m[1] = even + y[1];
  m[2] = even - y[1];
  m[3] = y[0] + 2 * y[1] + 4 * y[2];
  m[4] = y[2];
}

}  // namespace winograd
