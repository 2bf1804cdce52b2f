// SPDX-License-Identifier: Apache-2.0
// The same as hex_convolution.cpp for volumes of few channels, where transforms in the plane cost more than the products
// that they save.
//
// Sixteen channels are one vector. Winograd's F(4, 3) along the hypotheses halves the products: six planes of factors are
// convolved for every four of results, each directly, without the two zeros of a 3 x 3 kernel (7/9 of its arithmetic). A
// strip of rows at a time passes from given values to results, so that transforms never leave the cache; they cost a
// tenth of the products.

#include <ATen/Parallel.h>
#include <ATen/core/Tensor.h>
#include <ATen/Dispatch.h>
#include <torch/library.h>

#include <algorithm>
#include <optional>
#include <vector>

#include "lanes.h"
#include "volumes.h"
#include "winograd_lines.h"

namespace {

using lanes::LANES, lanes::load, lanes::store, lanes::Vec;
using volumes::inside, volumes::Volumes;

constexpr int64_t TAPS = 7;
constexpr int FACTORS = 6, RESULTS = 4;  // of F(4, 3), which begins one hypothesis before its results
constexpr int64_t STRIP_BYTES = 384 << 10;  // what a strip makes stays in the second-level cache

// Places of a row that are summed up at once, as many as there are registers for.
#if defined(__AVX512F__)
template <typename T>
constexpr int PLACES = sizeof(T) == 4 ? 20 : 10;
#else
template <typename T>
constexpr int PLACES = sizeof(T) == 4 ? 12 : 4;
#endif

// Six planes (rows, width) of vectors for each block of channels: a strip on its way.
template <typename T>
struct Strip {
  int64_t blocks, rows, width;
  std::vector<T>& data;

  Strip(std::vector<T>& buffer, const int64_t blocks, const int64_t rows, const int64_t width)
      : blocks(blocks), rows(rows), width(width), data(buffer) {
    if (const size_t size = FACTORS * blocks * rows * width * LANES; data.size() < size) data.resize(size);
  }

  int64_t block_step() const { return rows * width * LANES; }

  T* at(const int64_t plane, const int64_t block, const int64_t row, const int64_t column) {
    return data.data() + (((plane * blocks + block) * rows + row) * width + column) * LANES;
  }
};

// Given values of rows [first - 1, first + rows + 1), in places of results, and columns [-1, w], as factors.
template <typename T>
void read_factors(const Volumes<T>& given, const int64_t b, const int64_t group, const int64_t first, const int64_t border,
                  Strip<T>& factors) {
  Vec<T> d[FACTORS], x[FACTORS];
  int64_t planes[FACTORS];
  for (int k = 0; k < FACTORS; ++k) planes[k] = inside(group * RESULTS + k - 1, given.depth);
  for (int64_t block = 0; block < given.blocks; ++block) {
    const int64_t count = given.in_block(block);
    for (int64_t row = 0; row < factors.rows; ++row) {
      const int64_t y = inside(first + row - 1 + border, given.height);
      for (int64_t column = 0; column < factors.width; ++column) {
        const T* from = given.at(b, 0, y, inside(column - 1 + border, given.width), block);
        for (int k = 0; k < FACTORS; ++k) d[k] = load(from + planes[k] * given.deep, count);
        winograd::to_factors<T>(d, x);
        for (int k = 0; k < FACTORS; ++k) store(factors.at(k, block, row, column), x[k]);
      }
    }
  }
}

// Gradients of results as gradients of products, with `around` zeros on all sides of what is there.
template <typename T>
void read_products(const Volumes<T>& grad, const int64_t b, const int64_t group, const int64_t first, const int64_t around,
                   Strip<T>& products) {
  Vec<T> y[RESULTS], m[FACTORS];
  for (int64_t block = 0; block < grad.blocks; ++block) {
    const int64_t count = grad.in_block(block);
    for (int64_t row = 0; row < products.rows; ++row) {
      for (int64_t column = 0; column < products.width; ++column) {
        const int64_t i = first + row - around, j = column - around;
        const bool there = i >= 0 && i < grad.height && j >= 0 && j < grad.width;
        for (int k = 0; k < RESULTS; ++k) {
          const int64_t depth = group * RESULTS + k;
          y[k] = there && depth < grad.depth ? load(grad.at(b, depth, i, j, block), count) : Vec<T>{};
        }
        winograd::to_results_adjoint<T>(y, m);
        for (int k = 0; k < FACTORS; ++k) store(products.at(k, block, row, column), m[k]);
      }
    }
  }
}

// Convolve P places of a row: a product with the weights of each tap and channel, sixteen channels out at once.
template <typename T, int P>
inline void convolve_places(const T* given, const int64_t channels, const int64_t block_step, const int64_t* offsets,
                            const bool* used, const T* weight, const int64_t weight_step, T* result) {
  Vec<T> sum[P];
#pragma GCC unroll 32
  for (int p = 0; p < P; ++p) sum[p] = Vec<T>{};
  for (int64_t start = 0; start < channels; start += LANES, given += block_step) {
    const int64_t count = std::min(LANES, channels - start);
    for (int64_t tap = 0; tap < TAPS; ++tap) {
      if (!used[tap]) continue;
      const T *from = given + offsets[tap], *factor = weight + (tap * channels + start) * weight_step;
      for (int64_t c = 0; c < count; ++c, factor += weight_step) {
        const Vec<T> w = load(factor);
#pragma GCC unroll 32
        for (int p = 0; p < P; ++p) sum[p] += w * from[p * LANES + c];
      }
    }
  }
#pragma GCC unroll 32
  for (int p = 0; p < P; ++p) store(result + p * LANES, sum[p]);
}

template <typename T, int P>
inline void convolve_rest(const int64_t places, const T* given, const int64_t channels, const int64_t block_step,
                          const int64_t* offsets, const bool* used, const T* weight, const int64_t weight_step,
                          T* result) {
  if constexpr (P > 0) {
    if (places == P) {
      convolve_places<T, P>(given, channels, block_step, offsets, used, weight, weight_step, result);
    } else {
      convolve_rest<T, P - 1>(places, given, channels, block_step, offsets, used, weight, weight_step, result);
    }
  }
}

// Convolve all planes of a strip whose given rows are one more on each side. `weight` is (6, 7, C, O'), O' a multiple of 16.
// Taps that read rows outside [from, to) are left out: what is there is zero.
template <typename T>
void convolve_strip(Strip<T>& given, const T* weight, const int64_t channels, const int64_t* taps, const int64_t from,
                    const int64_t to, Strip<T>& result) {
  const int64_t weight_step = result.blocks * LANES;
  int64_t offsets[TAPS];
  for (int t = 0; t < TAPS; ++t) offsets[t] = (taps[t] / 3 * given.width + taps[t] % 3) * LANES;
  // As even parts of a row as can be.
  const int64_t parts = (result.width + PLACES<T> - 1) / PLACES<T>;
  for (int k = 0; k < FACTORS; ++k) {
    for (int64_t block = 0; block < result.blocks; ++block) {
      const T* factor = weight + k * TAPS * channels * weight_step + block * LANES;
      for (int64_t row = 0; row < result.rows; ++row) {
        bool used[TAPS];
        for (int t = 0; t < TAPS; ++t) used[t] = row + taps[t] / 3 >= from && row + taps[t] / 3 < to;
        for (int64_t part = 0; part < parts; ++part) {
          const int64_t first = part * result.width / parts, last = (part + 1) * result.width / parts;
          convolve_rest<T, PLACES<T>>(last - first, given.at(k, 0, row, first), channels, given.block_step(), offsets,
                                      used, factor, weight_step, result.at(k, block, row, first));
        }
      }
    }
  }
}

// Add the products of sixteen given channels with sixteen results, summed over a strip, to the gradient of a weight.
template <typename T>
void add_weight_gradient(Strip<T>& given, Strip<T>& grad, const int64_t channels, const int64_t* taps, T* total) {
  const int64_t weight_step = grad.blocks * LANES;
  for (int k = 0; k < FACTORS; ++k) {
    for (int64_t tap = 0; tap < TAPS; ++tap) {
      const int64_t down = taps[tap] / 3, right = taps[tap] % 3;
      for (int64_t block = 0; block < given.blocks; ++block) {
        for (int64_t out = 0; out < grad.blocks; ++out) {
          Vec<T> sum[LANES];
#pragma GCC unroll 32
          for (int c = 0; c < LANES; ++c) sum[c] = Vec<T>{};
          for (int64_t row = 0; row < grad.rows; ++row) {
            const T *x = given.at(k, block, row + down, right), *g = grad.at(k, out, row, 0);
            for (int64_t place = 0; place < grad.width; ++place, x += LANES, g += LANES) {
              const Vec<T> upstream = load(g);
#pragma GCC unroll 32
              for (int c = 0; c < LANES; ++c) sum[c] += upstream * x[c];
            }
          }
          T* to = total + ((k * TAPS + tap) * channels + block * LANES) * weight_step + out * LANES;
          const int64_t count = std::min(LANES, channels - block * LANES);
          for (int64_t c = 0; c < count; ++c, to += weight_step) store(to, Vec<T>(load(to) + sum[c]));
        }
      }
    }
  }
}

// Rows [first, last) of a strip, so many that it stays in cache, as even as can be.
struct Strips {
  int64_t count, rows;

  Strips(const int64_t rows, const int64_t bytes_of_row)
      : count(std::max<int64_t>(1, std::min(rows / 4, rows * bytes_of_row / STRIP_BYTES + 1))), rows(rows) {}

  int64_t first(const int64_t strip) const { return strip * rows / count; }
};

template <typename T>
std::vector<T>& buffer(const int which) {  // kept between calls: fresh pages cost as much as the sums
  thread_local std::vector<T> buffers[2];
  return buffers[which];
}

template <typename T>
void forward(const Volumes<T>& given, const T* weight, const int64_t* taps, const T* bias, const bool rectify,
             const int64_t border, const Volumes<T>& result) {
  const int64_t width = result.width, groups = (result.depth + RESULTS - 1) / RESULTS;
  const Strips strips(result.height, FACTORS * (width + 2) * (given.blocks + result.blocks) * LANES * sizeof(T));
  at::parallel_for(0, result.batch * groups * strips.count, 1, [&](const int64_t begin, const int64_t end) {
    for (int64_t task = begin; task < end; ++task) {
      const int64_t strip = task % strips.count, group = task / strips.count % groups, b = task / strips.count / groups;
      const int64_t first = strips.first(strip), rows = strips.first(strip + 1) - first;
      Strip<T> factors(buffer<T>(0), given.blocks, rows + 2, width + 2);
      Strip<T> products(buffer<T>(1), result.blocks, rows, width);
      read_factors(given, b, group, first, border, factors);
      convolve_strip(factors, weight, given.channels, taps, 0, rows + 2, products);
      const int64_t deep = std::min<int64_t>(RESULTS, result.depth - group * RESULTS);
      for (int64_t block = 0; block < result.blocks; ++block) {
        const int64_t count = result.in_block(block);
        const Vec<T> shift = bias ? load(bias + block * LANES, count) : Vec<T>{};
        Vec<T> m[FACTORS], y[RESULTS];
        for (int64_t row = 0; row < rows; ++row) {
          for (int64_t column = 0; column < width; ++column) {
            for (int k = 0; k < FACTORS; ++k) m[k] = load(products.at(k, block, row, column));
            winograd::to_results<T>(m, y);
            T* to = result.at(b, group * RESULTS, first + row, column, block);
            for (int64_t k = 0; k < deep; ++k) {
              const Vec<T> value = y[k] + shift;
              store(to + k * result.deep, rectify ? Vec<T>(value < Vec<T>{} ? Vec<T>{} : value) : value, count);
            }
          }
        }
      }
    }
  });
}

// The adjoint with respect to what is given, added to `grad_given`. Taps and weight are those of the adjoint.
template <typename T>
void backward_given(const Volumes<T>& grad, const T* weight, const int64_t* taps, const int64_t border,
                    const Volumes<T>& grad_given) {
  const int64_t groups = (grad.depth + RESULTS - 1) / RESULTS, width = grad.width + 2;
  const Strips strips(grad.height, FACTORS * (width + 2) * (grad.blocks + grad_given.blocks) * LANES * sizeof(T));
  // Strips are apart as the first and the last one take the border rows, which may be added to the rows next to them;
  // groups of hypotheses overlap, so they follow one another.
  at::parallel_for(0, grad.batch * strips.count, 1, [&](const int64_t begin, const int64_t end) {
    for (int64_t task = begin; task < end; ++task) {
      const int64_t strip = task % strips.count, b = task / strips.count;
      // In rows with border: row 0 is the one before the first.
      const int64_t first = strip == 0 ? 0 : strips.first(strip) + 1;
      const int64_t last = strip + 1 == strips.count ? grad.height + 2 : strips.first(strip + 1) + 1;
      const int64_t rows = last - first;
      for (int64_t group = 0; group < groups; ++group) {
        Strip<T> products(buffer<T>(0), grad.blocks, rows + 2, width + 2);
        Strip<T> factors(buffer<T>(1), grad_given.blocks, rows, width);
        read_products(grad, b, group, first, 2, products);
        convolve_strip(products, weight, grad.channels, taps, 2 - first, 2 - first + grad.height, factors);
        int64_t planes[FACTORS];
        for (int k = 0; k < FACTORS; ++k) planes[k] = inside(group * RESULTS + k - 1, grad_given.depth);
        Vec<T> x[FACTORS], d[FACTORS];
        for (int64_t block = 0; block < grad_given.blocks; ++block) {
          const int64_t count = grad_given.in_block(block);
          for (int64_t row = 0; row < rows; ++row) {
            const int64_t i = inside(first + row - 1 + border, grad_given.height);
            for (int64_t column = 0; column < width; ++column) {
              for (int k = 0; k < FACTORS; ++k) x[k] = load(factors.at(k, block, row, column));
              winograd::to_factors_adjoint<T>(x, d);
              T* to = grad_given.at(b, 0, i, inside(column - 1 + border, grad_given.width), block);
              for (int k = 0; k < FACTORS; ++k) {
                T* place = to + planes[k] * grad_given.deep;
                store(place, Vec<T>(load(place, count) + d[k]), count);
              }
            }
          }
        }
      }
    }
  });
}

// The adjoint with respect to the weight, (parts, 6, 7, C, O'): parts are summed up by who calls, always in the same order.
template <typename T>
void backward_weight(const Volumes<T>& given, const Volumes<T>& grad, const int64_t* taps, const int64_t border, T* totals,
                     const int64_t parts, const int64_t size) {
  const int64_t width = grad.width, groups = (grad.depth + RESULTS - 1) / RESULTS;
  const Strips strips(grad.height, FACTORS * (width + 2) * (given.blocks + grad.blocks) * LANES * sizeof(T));
  const int64_t tasks = grad.batch * groups * strips.count;
  at::parallel_for(0, parts, 1, [&](const int64_t begin, const int64_t end) {
    for (int64_t part = begin; part < end; ++part) {
      for (int64_t task = part * tasks / parts; task < (part + 1) * tasks / parts; ++task) {
        const int64_t strip = task % strips.count, group = task / strips.count % groups, b = task / strips.count / groups;
        const int64_t first = strips.first(strip), rows = strips.first(strip + 1) - first;
        Strip<T> factors(buffer<T>(0), given.blocks, rows + 2, width + 2);
        Strip<T> products(buffer<T>(1), grad.blocks, rows, width);
        read_factors(given, b, group, first, border, factors);
        read_products(grad, b, group, first, 0, products);
        add_weight_gradient(factors, products, given.channels, taps, totals + part * size);
      }
    }
  });
}

int64_t padded(const int64_t channels) { return (channels + LANES - 1) / LANES * LANES; }

// Check what belongs together.
void check(const at::Tensor& given, const at::Tensor& weight, const at::Tensor& taps, const at::Tensor& result,
           const int64_t border, const int64_t weight_place) {
  TORCH_CHECK(given.dim() == 5 && result.dim() == 5 && weight.dim() == weight_place + 4, "expected volumes (B, D, h, w, C)");
  TORCH_CHECK(given.scalar_type() == result.scalar_type() && given.scalar_type() == weight.scalar_type(),
              "expected one precision, got ", given.scalar_type(), ", ", result.scalar_type(), " and ", weight.scalar_type());
  TORCH_CHECK((border == 0 || border == 1) && given.size(0) == result.size(0) && given.size(1) == result.size(1) &&
                  given.size(2) == result.size(2) + 2 * border && given.size(3) == result.size(3) + 2 * border,
              "given values and results do not fit: ", given.sizes(), " and ", result.sizes());
  TORCH_CHECK(taps.is_contiguous() && taps.numel() == TAPS && taps.min().item<int64_t>() >= 0 &&
                  taps.max().item<int64_t>() < 9, "taps: expected seven places of nine");
  TORCH_CHECK(weight.is_contiguous() && weight.size(weight_place) == FACTORS && weight.size(weight_place + 1) == TAPS,
              "weight: expected (6, 7, C, O), got ", weight.sizes());
}

void hex_direct(const at::Tensor& given, const at::Tensor& weight, const at::Tensor& taps,
                const std::optional<at::Tensor>& bias, const bool rectify, const int64_t border, at::Tensor result) {
  check(given, weight, taps, result, border, 0);
  TORCH_CHECK(weight.size(2) == given.size(4) && weight.size(3) == padded(result.size(4)), "weight does not fit");
  TORCH_CHECK(!bias || (bias->is_contiguous() && bias->numel() == result.size(4) && bias->scalar_type() == given.scalar_type()),
              "bias: expected ", result.size(4), " values");
  AT_DISPATCH_FLOATING_TYPES(given.scalar_type(), "hex_direct", [&] {
    const Volumes<scalar_t> from(given, "given"), to(result, "result");
    const scalar_t* shift = bias ? bias->const_data_ptr<scalar_t>() : nullptr;
    forward(from, weight.const_data_ptr<scalar_t>(), taps.const_data_ptr<int64_t>(), shift, rectify, border, to);
  });
}

void hex_direct_backward_given(const at::Tensor& grad, const at::Tensor& weight, const at::Tensor& taps,
                                 const int64_t border, at::Tensor grad_given) {
  check(grad_given, weight, taps, grad, border, 0);
  TORCH_CHECK(weight.size(2) == grad.size(4) && weight.size(3) == padded(grad_given.size(4)), "weight does not fit");
  AT_DISPATCH_FLOATING_TYPES(grad.scalar_type(), "hex_direct_backward_given", [&] {
    const Volumes<scalar_t> from(grad, "grad"), to(grad_given, "grad_given");
    backward_given(from, weight.const_data_ptr<scalar_t>(), taps.const_data_ptr<int64_t>(), border, to);
  });
}

void hex_direct_backward_weight(const at::Tensor& given, const at::Tensor& grad, const at::Tensor& taps,
                                  const int64_t border, at::Tensor parts) {
  check(given, parts, taps, grad, border, 1);
  TORCH_CHECK(parts.size(3) == given.size(4) && parts.size(4) == padded(grad.size(4)), "parts do not fit");
  AT_DISPATCH_FLOATING_TYPES(grad.scalar_type(), "hex_direct_backward_weight", [&] {
    const Volumes<scalar_t> from(given, "given"), upstream(grad, "grad");
    backward_weight(from, upstream, taps.const_data_ptr<int64_t>(), border, parts.mutable_data_ptr<scalar_t>(),
                    parts.size(0), parts[0].numel());
  });
}

}  // namespace

TORCH_LIBRARY_FRAGMENT(sphericalvision, library) {
  library.def("hex_direct(Tensor given, Tensor weight, Tensor taps, Tensor? bias, bool rectify, int border, "
              "Tensor(a!) result) -> ()");
  library.def("hex_direct_backward_given(Tensor grad, Tensor weight, Tensor taps, int border, Tensor(a!) grad_given) -> ()");
  library.def("hex_direct_backward_weight(Tensor given, Tensor grad, Tensor taps, int border, Tensor(a!) parts) -> ()");
}

TORCH_LIBRARY_IMPL(sphericalvision, CPU, library) {
  library.impl("hex_direct", &hex_direct);
  library.impl("hex_direct_backward_given", &hex_direct_backward_given);
  library.impl("hex_direct_backward_weight", &hex_direct_backward_weight);
}
