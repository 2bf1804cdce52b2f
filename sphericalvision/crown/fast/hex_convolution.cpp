// SPDX-License-Identifier: Apache-2.0
// The same as hex_convolution.cpp for many channels: Winograd's F(3, 3) along rows and columns of a plane, too.
//
// A tile of 3 x 3 results takes 5 x 5 products, less two that are zero because two corners of a hexagon's 3 x 3 kernel
// are: 23 in place of 63. With F(4, 3) along the hypotheses volumes need 138 products for 36 results, in place of 756. Tiles
// of three fit planes of 2^k + 1 places, which are 3 m or 3 m - 1 on a side: those of 17 x 9 have 162 places of results in
// tiles of 3 x 3 and 240 in tiles of 4 x 4.
//
// A few rows of tiles at a time go from given values to results for one of the six factors of the hypotheses after the
// other, so that all between stays in the second-level cache. Gradients are the adjoints, step by step in reverse, so that
// they need as many products.

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

constexpr int64_t SIDE = 3, GIVEN = 5;       // results and given values along a side of a tile
constexpr int64_t SLOTS = GIVEN * GIVEN - 2;  // products of a tile, without the first and the last, which are zero
constexpr int64_t CACHE_BYTES = 640 << 10;    // what tiles and products take at a time

// What is summed up at once has as many registers as there are: so many vectors of results for so many tiles, and in the
// gradient of a weight so many vectors of results for so many given channels.
#if defined(__AVX512F__)
template <typename T>
constexpr int VECTORS = sizeof(T) == 4 ? 2 : 1;
template <typename T>
constexpr int TOGETHER = sizeof(T) == 4 ? 12 : 10;
template <typename T>
constexpr int CHANNELS = 8;
#else
template <typename T>
constexpr int VECTORS = 2;
template <typename T>
constexpr int TOGETHER = sizeof(T) == 4 ? 6 : 2;
template <typename T>
constexpr int CHANNELS = 4;
#endif

// Along the hypotheses: which factor comes from which given planes, and gives which results. Images have one of each.
template <int F>
struct Along;

template <>
struct Along<6> {
  static constexpr int given = 6, made = 4, before = 1;
  static constexpr int order[6] = {5, 0, 1, 2, 3, 4};  // the last one is part of every result
  template <typename T>
  static T from_given(const int k, const int d) { return winograd::GIVEN_TO_FACTORS<T>[k][d]; }
  template <typename T>
  static T to_result(const int k, const int j) { return winograd::PRODUCTS_TO_RESULTS<T>[j][k]; }
};

template <>
struct Along<1> {
  static constexpr int given = 1, made = 1, before = 0;
  static constexpr int order[1] = {0};
  template <typename T>
  static T from_given(int, int) { return 1; }
  template <typename T>
  static T to_result(int, int) { return 1; }
};

// Rows of tiles of all groups of four hypotheses of all rectangles.
struct Grid {
  int64_t batch, groups, rows, columns;

  template <typename T>
  Grid(const Volumes<T>& results, const int64_t made)
      : batch(results.batch),
        groups((results.depth + made - 1) / made),
        rows((results.height + SIDE - 1) / SIDE),
        columns((results.width + SIDE - 1) / SIDE) {}

  int64_t width() const { return SIDE * columns; }
  int64_t size() const { return batch * groups * rows; }

  // How many rows of tiles are taken together, of `number` for all threads.
  int64_t together(const int64_t number, const int64_t bytes_of_tile) const {
    const int64_t in_cache = CACHE_BYTES / (bytes_of_tile * columns), shared = number / at::get_num_threads();
    return std::clamp<int64_t>(std::min(in_cache, shared), 1, std::max<int64_t>(1, number));
  }
};

struct TileRow {
  int64_t b, group, row;
};

// Vectors of tiles, [slot][block][tile].
template <typename T>
struct Tiles {
  T* data;
  int64_t blocks, number;

  T* at(const int64_t slot, const int64_t block, const int64_t tile) const {
    return data + ((slot * blocks + block) * number + tile) * LANES;
  }
  int64_t slot_step() const { return blocks * number * LANES; }
  int64_t block_step() const { return number * LANES; }
};

// Memory of a thread, kept between calls: fresh pages cost as much as the sums.
template <typename T>
T* buffer(const int which, const int64_t size) {
  thread_local std::vector<T> buffers[3];
  if (static_cast<int64_t>(buffers[which].size()) < size) buffers[which].resize(size);
  return buffers[which].data();
}

// One factor of GIVEN rows of given values, [GIVEN][width + 2], to tiles from `first` on.
template <typename T, int F>
void tiles_of_given(const Volumes<T>& given, const Grid& grid, const TileRow& at, const int k, const int64_t border,
                    Tiles<T>& tiles, const int64_t first) {
  using A = Along<F>;
  const int64_t width = grid.width() + 2;
  Vec<T>* line = reinterpret_cast<Vec<T>*>(buffer<Vec<T>>(0, GIVEN * width));
  T factor[A::given];
  int64_t plane[A::given], terms = 0;
  for (int d = 0; d < A::given; ++d) {
    if (A::template from_given<T>(k, d) == 0) continue;
    factor[terms] = A::template from_given<T>(k, d);
    plane[terms++] = inside(at.group * A::made + d - A::before, given.depth) * given.deep;
  }
  for (int64_t block = 0; block < given.blocks; ++block) {
    const int64_t count = given.in_block(block);
    for (int64_t i = 0; i < GIVEN; ++i) {
      const int64_t y = inside(at.row * SIDE + i - 1 + border, given.height);
      for (int64_t j = 0; j < width; ++j) {
        const T* from = given.at(at.b, 0, y, inside(j - 1 + border, given.width), block);
        Vec<T> sum = load(from + plane[0], count) * factor[0];
        for (int64_t d = 1; d < terms; ++d) sum += load(from + plane[d], count) * factor[d];
        line[i * width + j] = sum;
      }
    }
    for (int64_t tile = 0; tile < grid.columns; ++tile) {
      Vec<T> x[GIVEN][GIVEN], in[GIVEN], out[GIVEN];
      for (int64_t i = 0; i < GIVEN; ++i) {
        for (int64_t j = 0; j < GIVEN; ++j) in[j] = line[i * width + SIDE * tile + j];
        winograd::to_factors(in, x[i]);
      }
      for (int64_t j = 0; j < GIVEN; ++j) {
        for (int64_t i = 0; i < GIVEN; ++i) in[i] = x[i][j];
        winograd::to_factors(in, out);
        for (int64_t i = 0; i < GIVEN; ++i) {
          const int64_t slot = i * GIVEN + j - 1;
          if (slot >= 0 && slot < SLOTS) store(tiles.at(slot, block, first + tile), out[i]);
        }
      }
    }
  }
}

// The adjoint of `tiles_of_given`: added to gradients of given values.
template <typename T, int F>
void add_tiles_to_given(Tiles<T>& tiles, const int64_t first, const Grid& grid, const TileRow& at, const int k,
                        const int64_t border, const Volumes<T>& grad_given) {
  using A = Along<F>;
  const int64_t width = grid.width() + 2;
  Vec<T>* line = reinterpret_cast<Vec<T>*>(buffer<Vec<T>>(0, GIVEN * width));
  for (int64_t block = 0; block < grad_given.blocks; ++block) {
    const int64_t count = grad_given.in_block(block);
    std::fill(line, line + GIVEN * width, Vec<T>{});
    for (int64_t tile = 0; tile < grid.columns; ++tile) {
      Vec<T> x[GIVEN][GIVEN], in[GIVEN], out[GIVEN];
      for (int64_t j = 0; j < GIVEN; ++j) {
        for (int64_t i = 0; i < GIVEN; ++i) {
          const int64_t slot = i * GIVEN + j - 1;
          in[i] = slot >= 0 && slot < SLOTS ? load(tiles.at(slot, block, first + tile)) : Vec<T>{};
        }
        winograd::to_factors_adjoint(in, out);
        for (int64_t i = 0; i < GIVEN; ++i) x[i][j] = out[i];
      }
      for (int64_t i = 0; i < GIVEN; ++i) {
        winograd::to_factors_adjoint(x[i], out);
        for (int64_t j = 0; j < GIVEN; ++j) line[i * width + SIDE * tile + j] += out[j];
      }
    }
    for (int d = 0; d < A::given; ++d) {
      const T factor = A::template from_given<T>(k, d);
      if (factor == 0) continue;
      const int64_t plane = inside(at.group * A::made + d - A::before, grad_given.depth);
      for (int64_t i = 0; i < GIVEN; ++i) {
        const int64_t y = inside(at.row * SIDE + i - 1 + border, grad_given.height);
        for (int64_t j = 0; j < width; ++j) {
          T* to = grad_given.at(at.b, plane, y, inside(j - 1 + border, grad_given.width), block);
          store(to, Vec<T>(load(to, count) + line[i * width + j] * factor), count);
        }
      }
    }
  }
}

// What one factor's products are of results; the first time with the bias, the last time rectified.
template <typename T, int F>
void add_tiles_to_results(Tiles<T>& products, const int64_t first, const Grid& grid, const TileRow& at, const int k,
                          const T* bias, const bool rectify, const Volumes<T>& results) {
  using A = Along<F>;
  const bool begin = k == A::order[0], end = k == A::order[F - 1];
  const int64_t high = std::min(SIDE, results.height - at.row * SIDE);
  const int64_t deep = std::min<int64_t>(A::made, results.depth - at.group * A::made);
  for (int64_t block = 0; block < results.blocks; ++block) {
    const int64_t count = results.in_block(block);
    const Vec<T> shift = bias ? load(bias + block * LANES, count) : Vec<T>{};
    for (int64_t tile = 0; tile < grid.columns; ++tile) {
      Vec<T> x[SIDE][GIVEN], y[SIDE][SIDE], in[GIVEN], out[SIDE];
      for (int64_t j = 0; j < GIVEN; ++j) {
        for (int64_t i = 0; i < GIVEN; ++i) {
          const int64_t slot = i * GIVEN + j - 1;
          in[i] = slot >= 0 && slot < SLOTS ? load(products.at(slot, block, first + tile)) : Vec<T>{};
        }
        winograd::to_results(in, out);
        for (int64_t i = 0; i < SIDE; ++i) x[i][j] = out[i];
      }
      for (int64_t i = 0; i < SIDE; ++i) winograd::to_results(x[i], y[i]);
      const int64_t wide = std::min(SIDE, results.width - tile * SIDE);
      for (int64_t d = 0; d < deep; ++d) {
        const T factor = A::template to_result<T>(k, d);
        if (factor == 0 && !begin) continue;
        for (int64_t i = 0; i < high; ++i) {
          T* to = results.at(at.b, at.group * A::made + d, at.row * SIDE + i, tile * SIDE, block);
          for (int64_t j = 0; j < wide; ++j, to += results.right) {
            Vec<T> value = (begin ? shift : load(to, count)) + y[i][j] * factor;
            if (end && rectify) value = value < Vec<T>{} ? Vec<T>{} : value;  // NaN stays
            store(to, value, count);
          }
        }
      }
    }
  }
}

// The adjoint of `add_tiles_to_results`.
template <typename T, int F>
void tiles_of_results(const Volumes<T>& grad, const Grid& grid, const TileRow& at, const int k, Tiles<T>& tiles,
                      const int64_t first) {
  using A = Along<F>;
  T factor[A::made];
  int64_t plane[A::made], terms = 0;
  for (int d = 0; d < A::made; ++d) {
    const int64_t depth = at.group * A::made + d;
    if (A::template to_result<T>(k, d) == 0 || depth >= grad.depth) continue;
    factor[terms] = A::template to_result<T>(k, d);
    plane[terms++] = depth * grad.deep;
  }
  for (int64_t block = 0; block < grad.blocks; ++block) {
    const int64_t count = grad.in_block(block);
    for (int64_t tile = 0; tile < grid.columns; ++tile) {
      Vec<T> x[SIDE][GIVEN], y[SIDE], in[SIDE], out[GIVEN];
      for (int64_t i = 0; i < SIDE; ++i) {
        for (int64_t j = 0; j < SIDE; ++j) {
          const int64_t row = at.row * SIDE + i, column = tile * SIDE + j;
          y[j] = Vec<T>{};
          if (row >= grad.height || column >= grad.width) continue;
          const T* from = grad.at(at.b, 0, row, column, block);
          for (int64_t d = 0; d < terms; ++d) y[j] += load(from + plane[d], count) * factor[d];
        }
        winograd::to_results_adjoint(y, x[i]);
      }
      for (int64_t j = 0; j < GIVEN; ++j) {
        for (int64_t i = 0; i < SIDE; ++i) in[i] = x[i][j];
        winograd::to_results_adjoint(in, out);
        for (int64_t i = 0; i < GIVEN; ++i) {
          const int64_t slot = i * GIVEN + j - 1;
          if (slot >= 0 && slot < SLOTS) store(tiles.at(slot, block, first + tile), out[i]);
        }
      }
    }
  }
}

// Multiply P tiles with the weights (C, O') of V vectors of results.
template <typename T, int P, int V>
inline void multiply_tiles(const T* given, const int64_t channels, const int64_t given_step, const T* weight,
                           const int64_t weight_step, T* made, const int64_t made_step) {
  Vec<T> sum[V][P];
#pragma GCC unroll 32
  for (int p = 0; p < P; ++p) {
#pragma GCC unroll 2
    for (int v = 0; v < V; ++v) sum[v][p] = Vec<T>{};
  }
  for (int64_t start = 0; start < channels; start += LANES, given += given_step) {
    const int64_t count = std::min(LANES, channels - start);
    for (int64_t c = 0; c < count; ++c, weight += weight_step) {
      Vec<T> w[V];
#pragma GCC unroll 2
      for (int v = 0; v < V; ++v) w[v] = load(weight + v * LANES);
#pragma GCC unroll 32
      for (int p = 0; p < P; ++p) {
#pragma GCC unroll 2
        for (int v = 0; v < V; ++v) sum[v][p] += w[v] * given[p * LANES + c];
      }
    }
  }
#pragma GCC unroll 32
  for (int p = 0; p < P; ++p) {
#pragma GCC unroll 2
    for (int v = 0; v < V; ++v) store(made + v * made_step + p * LANES, sum[v][p]);
  }
}

template <typename T, int P, int V>
inline void multiply_some(const int64_t tiles, const T* given, const int64_t channels, const int64_t given_step,
                          const T* weight, const int64_t weight_step, T* made, const int64_t made_step) {
  if constexpr (P > 0) {
    if (tiles == P) {
      multiply_tiles<T, P, V>(given, channels, given_step, weight, weight_step, made, made_step);
    } else {
      multiply_some<T, P - 1, V>(tiles, given, channels, given_step, weight, weight_step, made, made_step);
    }
  }
}

// All products of tiles with weights (SLOTS, C, O'), O' a multiple of sixteen.
template <typename T>
void multiply(Tiles<T>& given, const int64_t channels, const T* weight, Tiles<T>& made) {
  const int64_t weight_step = made.blocks * LANES, parts = (given.number + TOGETHER<T> - 1) / TOGETHER<T>;
  for (int64_t slot = 0; slot < SLOTS; ++slot, weight += channels * weight_step) {
    for (int64_t block = 0; block < made.blocks; block += VECTORS<T>) {
      for (int64_t part = 0; part < parts; ++part) {  // as even as can be
        const int64_t first = part * given.number / parts, last = (part + 1) * given.number / parts;
        const T *from = given.at(slot, 0, first), *factor = weight + block * LANES;
        T* to = made.at(slot, block, first);
        if (block + VECTORS<T> <= made.blocks) {
          multiply_some<T, TOGETHER<T>, VECTORS<T>>(last - first, from, channels, given.block_step(), factor, weight_step,
                                                    to, made.block_step());
        } else {
          multiply_some<T, TOGETHER<T>, 1>(last - first, from, channels, given.block_step(), factor, weight_step, to,
                                           made.block_step());
        }
      }
    }
  }
}

// Add the products of CHANNELS given channels with V vectors of gradients, summed over tiles, to a weight's gradient.
template <typename T, int V>
inline void add_sum_over_tiles(const T* given, const T* grad, const int64_t grad_step, const int64_t tiles,
                               const int64_t count, T* total, const int64_t total_step) {
  Vec<T> sum[V][CHANNELS<T>];
#pragma GCC unroll 32
  for (int c = 0; c < CHANNELS<T>; ++c) {
#pragma GCC unroll 2
    for (int v = 0; v < V; ++v) sum[v][c] = Vec<T>{};
  }
  for (int64_t tile = 0; tile < tiles; ++tile, given += LANES, grad += LANES) {
    Vec<T> g[V];
#pragma GCC unroll 2
    for (int v = 0; v < V; ++v) g[v] = load(grad + v * grad_step);
#pragma GCC unroll 32
    for (int c = 0; c < CHANNELS<T>; ++c) {
#pragma GCC unroll 2
      for (int v = 0; v < V; ++v) sum[v][c] += g[v] * given[c];
    }
  }
  for (int64_t c = 0; c < count; ++c, total += total_step) {
    for (int v = 0; v < V; ++v) store(total + v * LANES, Vec<T>(load(total + v * LANES) + sum[v][c]));
  }
}

// The gradient of weights (SLOTS, C, O') of one factor.
template <typename T>
void add_weight_gradient(Tiles<T>& given, Tiles<T>& grad, const int64_t channels, T* total) {
  const int64_t step = grad.blocks * LANES;
  for (int64_t slot = 0; slot < SLOTS; ++slot, total += channels * step) {
    for (int64_t channel = 0; channel < channels; channel += CHANNELS<T>) {
      const int64_t count = std::min<int64_t>(CHANNELS<T>, channels - channel);
      const T* from = given.at(slot, channel / LANES, 0) + channel % LANES;
      for (int64_t block = 0; block < grad.blocks; block += VECTORS<T>) {
        T* to = total + channel * step + block * LANES;
        if (block + VECTORS<T> <= grad.blocks) {
          add_sum_over_tiles<T, VECTORS<T>>(from, grad.at(slot, block, 0), grad.block_step(), given.number, count, to, step);
        } else {
          add_sum_over_tiles<T, 1>(from, grad.at(slot, block, 0), grad.block_step(), given.number, count, to, step);
        }
      }
    }
  }
}

// Tiles of given values and of results in the memory of this thread.
template <typename T>
std::pair<Tiles<T>, Tiles<T>> make_tiles(const int64_t given_blocks, const int64_t result_blocks, const int64_t number) {
  return {Tiles<T>{buffer<T>(1, SLOTS * given_blocks * number * LANES), given_blocks, number},
          Tiles<T>{buffer<T>(2, SLOTS * result_blocks * number * LANES), result_blocks, number}};
}

template <typename T>
int64_t bytes_of_tile(const Volumes<T>& given, const Volumes<T>& results) {
  return SLOTS * (given.blocks + results.blocks) * LANES * sizeof(T);
}

// Call `one(first, last)` in parallel for parts of `number` rows of tiles that are no more than `together`.
template <typename Function>
void for_parts(const int64_t number, const int64_t together, const Function& one) {
  const int64_t parts = (number + together - 1) / together;
  at::parallel_for(0, parts, 1, [&](const int64_t begin, const int64_t end) {
    for (int64_t part = begin; part < end; ++part) one(part * number / parts, (part + 1) * number / parts);
  });
}

template <typename T, int F>
void forward(const Volumes<T>& given, const T* weight, const T* bias, const bool rectify, const int64_t border,
             const Volumes<T>& results) {
  using A = Along<F>;
  const Grid grid(results, A::made);
  const int64_t size = SLOTS * given.channels * results.blocks * LANES;
  const auto tile_row = [&](const int64_t i) {
    return TileRow{i / grid.rows / grid.groups, i / grid.rows % grid.groups, i % grid.rows};
  };
  for_parts(grid.size(), grid.together(grid.size(), bytes_of_tile(given, results)), [&](const int64_t first, const int64_t last) {
    auto [tiles, products] = make_tiles<T>(given.blocks, results.blocks, (last - first) * grid.columns);
    for (const int k : A::order) {
      for (int64_t i = first; i < last; ++i)
        tiles_of_given<T, F>(given, grid, tile_row(i), k, border, tiles, (i - first) * grid.columns);
      multiply(tiles, given.channels, weight + k * size, products);
      for (int64_t i = first; i < last; ++i)
        add_tiles_to_results<T, F>(products, (i - first) * grid.columns, grid, tile_row(i), k, bias, rectify, results);
    }
  });
}

// The adjoint with respect to what is given, added to `grad_given`. The weight is (F, SLOTS, O, C').
template <typename T, int F>
void backward_given(const Volumes<T>& grad, const T* weight, const int64_t border, const Volumes<T>& grad_given) {
  using A = Along<F>;
  const Grid grid(grad, A::made);
  const int64_t size = SLOTS * grad.channels * grad_given.blocks * LANES;
  // Neighbouring rows of tiles and neighbouring groups of hypotheses add to the same places, those after next do not:
  // even ones and odd ones take turns.
  for (int64_t turn = 0; turn < 4; ++turn) {
    const int64_t odd_row = turn % 2, odd_group = turn / 2;
    const int64_t rows = (grid.rows + 1 - odd_row) / 2, groups = (grid.groups + 1 - odd_group) / 2;
    const int64_t number = grid.batch * groups * rows;
    const auto tile_row = [&](const int64_t i) {
      return TileRow{i / rows / groups, 2 * (i / rows % groups) + odd_group, 2 * (i % rows) + odd_row};
    };
    for_parts(number, grid.together(number, bytes_of_tile(grad_given, grad)), [&](const int64_t first, const int64_t last) {
      auto [made, tiles] = make_tiles<T>(grad_given.blocks, grad.blocks, (last - first) * grid.columns);
      for (const int k : A::order) {
        for (int64_t i = first; i < last; ++i)
          tiles_of_results<T, F>(grad, grid, tile_row(i), k, tiles, (i - first) * grid.columns);
        multiply(tiles, grad.channels, weight + k * size, made);
        for (int64_t i = first; i < last; ++i)
          add_tiles_to_given<T, F>(made, (i - first) * grid.columns, grid, tile_row(i), k, border, grad_given);
      }
    });
  }
}

// The adjoint with respect to the weight, (parts, F, SLOTS, C, O'): parts are summed up by who calls, always in the same
// order. A factor's part stays in cache while many tiles pass.
template <typename T, int F>
void backward_weight(const Volumes<T>& given, const Volumes<T>& grad, const int64_t border, T* totals, const int64_t parts) {
  using A = Along<F>;
  const Grid grid(grad, A::made);
  const int64_t size = SLOTS * given.channels * grad.blocks * LANES, number = grid.size();
  const int64_t together = grid.together(number, bytes_of_tile(given, grad));
  const auto tile_row = [&](const int64_t i) {
    return TileRow{i / grid.rows / grid.groups, i / grid.rows % grid.groups, i % grid.rows};
  };
  at::parallel_for(0, parts, 1, [&](const int64_t begin, const int64_t end) {
    for (int64_t part = begin; part < end; ++part) {
      const int64_t from = part * number / parts, to = (part + 1) * number / parts;
      for (const int k : A::order) {
        for (int64_t first = from; first < to; first += together) {
          const int64_t last = std::min(first + together, to);
          auto [tiles, upstream] = make_tiles<T>(given.blocks, grad.blocks, (last - first) * grid.columns);
          for (int64_t i = first; i < last; ++i) {
            tiles_of_given<T, F>(given, grid, tile_row(i), k, border, tiles, (i - first) * grid.columns);
            tiles_of_results<T, F>(grad, grid, tile_row(i), k, upstream, (i - first) * grid.columns);
          }
          add_weight_gradient(tiles, upstream, given.channels, totals + (part * F + k) * size);
        }
      }
    }
  });
}

int64_t padded(const int64_t channels) { return (channels + LANES - 1) / LANES * LANES; }

// Check what belongs together and return whether hypotheses go through Winograd's transforms.
bool check(const at::Tensor& given, const at::Tensor& weight, const at::Tensor& result, const int64_t border,
           const int64_t weight_place) {
  TORCH_CHECK(given.dim() == 5 && result.dim() == 5 && weight.dim() == weight_place + 4, "expected volumes (B, D, h, w, C)");
  TORCH_CHECK(given.scalar_type() == result.scalar_type() && given.scalar_type() == weight.scalar_type(),
              "expected one precision, got ", given.scalar_type(), ", ", result.scalar_type(), " and ", weight.scalar_type());
  TORCH_CHECK((border == 0 || border == 1) && given.size(0) == result.size(0) && given.size(1) == result.size(1) &&
                  given.size(2) == result.size(2) + 2 * border && given.size(3) == result.size(3) + 2 * border,
              "given values and results do not fit: ", given.sizes(), " and ", result.sizes());
  const int64_t planes = weight.size(weight_place);
  TORCH_CHECK((planes == 6 || (planes == 1 && given.size(1) == 1)) && weight.is_contiguous() &&
                  weight.size(weight_place + 1) == SLOTS,
              "weight: expected (6 or 1, ", SLOTS, ", C, O), got ", weight.sizes());
  return planes == 6;
}

void hex_convolve(const at::Tensor& given, const at::Tensor& weight, const std::optional<at::Tensor>& bias, const bool rectify,
               const int64_t border, at::Tensor result) {
  const bool transformed = check(given, weight, result, border, 0);
  TORCH_CHECK(weight.size(2) == given.size(4) && weight.size(3) == padded(result.size(4)), "weight does not fit");
  TORCH_CHECK(!bias || (bias->is_contiguous() && bias->numel() == result.size(4) && bias->scalar_type() == given.scalar_type()),
              "bias: expected ", result.size(4), " values");
  AT_DISPATCH_FLOATING_TYPES(given.scalar_type(), "hex_convolve", [&] {
    const Volumes<scalar_t> from(given, "given"), to(result, "result");
    const scalar_t* shift = bias ? bias->const_data_ptr<scalar_t>() : nullptr;
    (transformed ? forward<scalar_t, 6> : forward<scalar_t, 1>)(
        from, weight.const_data_ptr<scalar_t>(), shift, rectify, border, to);
  });
}

void hex_convolve_backward_given(const at::Tensor& grad, const at::Tensor& weight, const int64_t border, at::Tensor grad_given) {
  const bool transformed = check(grad_given, weight, grad, border, 0);
  TORCH_CHECK(weight.size(2) == grad.size(4) && weight.size(3) == padded(grad_given.size(4)), "weight does not fit");
  AT_DISPATCH_FLOATING_TYPES(grad.scalar_type(), "hex_convolve_backward_given", [&] {
    const Volumes<scalar_t> from(grad, "grad"), to(grad_given, "grad_given");
    (transformed ? backward_given<scalar_t, 6> : backward_given<scalar_t, 1>)(
        from, weight.const_data_ptr<scalar_t>(), border, to);
  });
}

void hex_convolve_backward_weight(const at::Tensor& given, const at::Tensor& grad, const int64_t border, at::Tensor parts) {
  const bool transformed = check(given, parts, grad, border, 1);
  TORCH_CHECK(parts.size(3) == given.size(4) && parts.size(4) == padded(grad.size(4)), "parts do not fit");
  AT_DISPATCH_FLOATING_TYPES(grad.scalar_type(), "hex_convolve_backward_weight", [&] {
    const Volumes<scalar_t> from(given, "given"), upstream(grad, "grad");
    (transformed ? backward_weight<scalar_t, 6> : backward_weight<scalar_t, 1>)(
        from, upstream, border, parts.mutable_data_ptr<scalar_t>(), parts.size(0));
  });
}

}  // namespace

TORCH_LIBRARY_FRAGMENT(sphericalvision, library) {
  library.def("lanes() -> int", [] { return LANES; });
  library.def("hex_convolve(Tensor given, Tensor weight, Tensor? bias, bool rectify, int border, Tensor(a!) result) -> ()");
  library.def("hex_convolve_backward_given(Tensor grad, Tensor weight, int border, Tensor(a!) grad_given) -> ()");
  library.def("hex_convolve_backward_weight(Tensor given, Tensor grad, int border, Tensor(a!) parts) -> ()");
}

TORCH_LIBRARY_IMPL(sphericalvision, CPU, library) {
  library.impl("hex_convolve", &hex_convolve);
  library.impl("hex_convolve_backward_given", &hex_convolve_backward_given);
  library.impl("hex_convolve_backward_weight", &hex_convolve_backward_weight);
}
