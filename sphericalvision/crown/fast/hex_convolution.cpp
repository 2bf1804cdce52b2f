// SPDX-License-Identifier: Apache-2.0
// Hexagonal convolutions by Winograd's minimal filtering: F(3, 3) along rows and columns of a plane, F(4, 3) along hypotheses.
//
// A tile of 3 x 3 results takes 5 x 5 products, less two that are zero because two corners of a hexagon's 3 x 3 kernel
// are: 23 in place of 63. With F(4, 3) along the hypotheses volumes need 138 products for 36 results, in place of 756. Tiles
// of three fit planes of 2^k + 1 places, which are 3 m or 3 m - 1 on a side: those of 17 x 9 have 162 places of results in
// tiles of 3 x 3 and 240 in tiles of 4 x 4.
//
// A strip is some rows of tiles of four hypotheses of a rectangle. A few strips at a time go all the way:
//
//   given --F(4, 3)--> planes [6][row][column] --F(3, 3)--> tiles [23][tile] --times the weight-->
//   products [23][tile] --F(3, 3)--> planes [6][row][column] --F(4, 3)--> results
//
// so that every given value is read, and every result written, once, in the order of memory, and nothing between leaves the
// caches. The factors of the hypotheses take turns at the middle, so that a sixth of the weight is in use at a time. The
// weight is made anew for every call, taps --F(4, 3)--> kernels [6][3][3] --F(3, 3)--> factors [6][23], in the order in
// which it is read: that is cheaper than to know whether one that was kept is still the same. Borders
// are repeated while reading, not copied around. Gradients are the adjoints, step by step in reverse, and need as many
// products. Images are volumes of one hypothesis, which F(4, 3) leaves out.

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
using volumes::CHARTS, volumes::inside, volumes::Scaling, volumes::Volumes;

constexpr int64_t HEXAGON = 7;                // taps of a hypothesis
constexpr int64_t SIDE = 3, GIVEN = 5;       // results and given values along a side of a tile
constexpr int64_t SLOTS = GIVEN * GIVEN - 2;  // products of a tile, without the first and the last, which are zero
constexpr int64_t TILES = 24;                 // at a time: enough to pay for reading a weight, few enough to stay in cache

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

// Planes of factors, hypotheses that these make, hypotheses before those, and hypotheses that a tap is of.
template <int F>
constexpr int64_t MADE = F == 6 ? 4 : 1;
template <int F>
constexpr int64_t BEFORE = F == 6 ? 1 : 0;
template <int F>
constexpr int64_t TAP_HYPOTHESES = F == 6 ? 3 : 1;

// Rows of tiles of a group of hypotheses of a rectangle; which strip in hand it is, and the first of its tiles there.
struct Strip {
  int64_t b, group, first, rows, index, tile;
};

// How results are cut into strips, all of about TILES tiles or of a whole plane.
struct Grid {
  int64_t batch, groups, rows, columns, parts;

  template <typename T>
  Grid(const Volumes<T>& results, const int64_t made)
      : batch(results.batch),
        groups((results.depth + made - 1) / made),
        rows((results.height + SIDE - 1) / SIDE),
        columns((results.width + SIDE - 1) / SIDE),
        parts(std::min((rows * columns + TILES - 1) / TILES, rows)) {}

  int64_t size() const { return batch * groups * parts; }
  int64_t most_rows() const { return (rows + parts - 1) / parts; }
  Strip strip(const int64_t b, const int64_t group, const int64_t part) const {
    const int64_t first = part * rows / parts;
    return {b, group, first, (part + 1) * rows / parts - first, 0, 0};
  }
  Strip strip(const int64_t i) const { return strip(i / parts / groups, i / parts % groups, i % parts); }
};

// Planes of vectors, [plane][row][column][block]: a strip of given values with one more place all around, or of results.
template <typename T>
struct Planes {
  T* data;
  int64_t rows, columns, blocks;

  T* at(const int64_t plane, const int64_t row, const int64_t column) const {
    return data + ((plane * rows + row) * columns + column) * blocks * LANES;
  }
  int64_t step() const { return rows * columns * blocks * LANES; }
};

// Vectors of tiles, [slot][block][tile]. The step is odd: a power of two would put all slots into one set of the cache.
template <typename T>
struct Tiles {
  T* data;
  int64_t blocks, number, step;

  T* at(const int64_t slot, const int64_t block, const int64_t tile) const {
    return data + ((slot * blocks + block) * step + tile) * LANES;
  }
  int64_t slot_step() const { return blocks * step * LANES; }
  int64_t block_step() const { return step * LANES; }
};

// Memory of a thread, kept between calls: fresh pages cost as much as the sums. Vectors, so that none lies in two lines of
// the cache.
template <typename T>
T* buffer(const int which, const int64_t vectors) {
  thread_local std::vector<Vec<T>> buffers[4];
  if (static_cast<int64_t>(buffers[which].size()) < vectors) buffers[which].resize(vectors);
  return reinterpret_cast<T*>(buffers[which].data());
}

// Strips in hand, with planes and tiles of given values and of results.
template <typename T, int F>
struct Hand {
  const Grid& grid;
  std::vector<Strip> strips;
  int64_t given_blocks, result_blocks, number = 0;

  Hand(const Grid& grid, std::vector<Strip> some, const int64_t given_blocks, const int64_t result_blocks)
      : grid(grid), strips(std::move(some)), given_blocks(given_blocks), result_blocks(result_blocks) {
    for (Strip& strip : strips) {
      strip.index = &strip - strips.data();
      strip.tile = number;
      number += strip.rows * grid.columns;
    }
  }

  Planes<T> planes(const int which, const Strip& strip, const int64_t more, const int64_t blocks) const {
    const int64_t columns = SIDE * grid.columns + more, most = F * (SIDE * grid.most_rows() + more) * columns * blocks;
    T* all = buffer<T>(which, most * strips.size());
    return {all + strip.index * most * LANES, SIDE * strip.rows + more, columns, blocks};
  }
  Planes<T> given(const Strip& strip) const { return planes(0, strip, GIVEN - SIDE, given_blocks); }
  Planes<T> results(const Strip& strip) const { return planes(1, strip, 0, result_blocks); }

  Tiles<T> tiles(const int which, const int64_t blocks) const {
    return {buffer<T>(which, SLOTS * blocks * (number | 1)), blocks, number, number | 1};
  }
  Tiles<T> given_tiles() const { return tiles(2, given_blocks); }
  Tiles<T> result_tiles() const { return tiles(3, result_blocks); }
};

// Along the hypotheses: given values of a strip and around it to planes of factors.
template <typename T, int F>
void read_given(const Volumes<T>& given, const Scaling<T>& scaling, const Strip& strip, const int64_t border,
                const Planes<T>& planes) {
  int64_t depth[F];
  for (int k = 0; k < F; ++k) depth[k] = inside(strip.group * MADE<F> + k - BEFORE<F>, given.depth) * given.deep;
  for (int64_t row = 0; row < planes.rows; ++row) {
    const int64_t y = inside(strip.first * SIDE + row - 1 + border, given.height);
    for (int64_t column = 0; column < planes.columns; ++column) {
      const T* from = given.at(strip.b, 0, y, inside(column - 1 + border, given.width), 0);
      T* to = planes.at(0, row, column);
      for (int64_t block = 0; block < planes.blocks; ++block, from += LANES, to += LANES) {
        const int64_t count = given.in_block(block);
        Vec<T> d[F], x[F];
        for (int k = 0; k < F; ++k) d[k] = load(from + depth[k], count);
        if (scaling.factor)
          for (Vec<T>& value : d) value = lanes::rectified<T>(scaling.scaled(value, strip.b, block, count));
        winograd::line<winograd::GIVEN_6, false>(d, x);
        for (int k = 0; k < F; ++k) store(to + k * planes.step(), x[k]);
      }
    }
  }
}

// The adjoint of `read_given`: added to gradients of given values.
template <typename T, int F>
void add_to_given(const Planes<T>& planes, const Strip& strip, const int64_t border, const Volumes<T>& grad_given) {
  int64_t depth[F];
  for (int k = 0; k < F; ++k) depth[k] = inside(strip.group * MADE<F> + k - BEFORE<F>, grad_given.depth) * grad_given.deep;
  for (int64_t row = 0; row < planes.rows; ++row) {
    const int64_t y = inside(strip.first * SIDE + row - 1 + border, grad_given.height);
    for (int64_t column = 0; column < planes.columns; ++column) {
      T* to = grad_given.at(strip.b, 0, y, inside(column - 1 + border, grad_given.width), 0);
      const T* from = planes.at(0, row, column);
      for (int64_t block = 0; block < planes.blocks; ++block, from += LANES, to += LANES) {
        const int64_t count = grad_given.in_block(block);
        Vec<T> x[F], d[F];
        for (int k = 0; k < F; ++k) x[k] = load(from + k * planes.step());
        winograd::line<winograd::GIVEN_6, true>(x, d);
        // One after the other: at the ends two of them are the same hypothesis.
        for (int k = 0; k < F; ++k) store(to + depth[k], Vec<T>(load(to + depth[k], count) + d[k]), count);
      }
    }
  }
}

// Along the hypotheses: planes of products to results, with the bias, and rectified if asked for.
template <typename T, int F>
void write_results(const Planes<T>& planes, const Strip& strip, const T* bias, const bool rectify, const Volumes<T>& results) {
  const int64_t depth = strip.group * MADE<F>, deep = std::min<int64_t>(MADE<F>, results.depth - depth);
  const int64_t rows = std::min(planes.rows, results.height - strip.first * SIDE);
  for (int64_t row = 0; row < rows; ++row) {
    for (int64_t column = 0; column < results.width; ++column) {
      const T* from = planes.at(0, row, column);
      T* to = results.at(strip.b, depth, strip.first * SIDE + row, column, 0);
      for (int64_t block = 0; block < planes.blocks; ++block, from += LANES, to += LANES) {
        const int64_t count = results.in_block(block);
        const Vec<T> shift = bias ? load(bias + block * LANES, count) : Vec<T>{};
        Vec<T> m[F], y[MADE<F>];
        for (int k = 0; k < F; ++k) m[k] = load(from + k * planes.step());
        winograd::line<winograd::RESULTS_6, false>(m, y);
        for (int64_t k = 0; k < deep; ++k) {
          const Vec<T> value = y[k] + shift;
          store(to + k * results.deep, rectify ? lanes::rectified<T>(value) : value, count);
        }
      }
    }
  }
}

// The adjoint of `write_results`: gradients of results to planes, zero where there are no results.
template <typename T, int F>
void read_gradients(const Volumes<T>& grad, const Strip& strip, const Planes<T>& planes) {
  const int64_t depth = strip.group * MADE<F>, deep = std::min<int64_t>(MADE<F>, grad.depth - depth);
  for (int64_t row = 0; row < planes.rows; ++row) {
    for (int64_t column = 0; column < planes.columns; ++column) {
      const int64_t i = strip.first * SIDE + row;
      const bool there = i < grad.height && column < grad.width;
      const T* from = grad.at(strip.b, depth, there ? i : 0, there ? column : 0, 0);
      T* to = planes.at(0, row, column);
      for (int64_t block = 0; block < planes.blocks; ++block, from += LANES, to += LANES) {
        Vec<T> y[MADE<F>], m[F];
        for (int64_t k = 0; k < MADE<F>; ++k)
          y[k] = there && k < deep ? load(from + k * grad.deep, grad.in_block(block)) : Vec<T>{};
        winograd::line<winograd::RESULTS_6, true>(y, m);
        for (int k = 0; k < F; ++k) store(to + k * planes.step(), m[k]);
      }
    }
  }
}

// All slots of a tile but the two that are always zero.
template <typename T>
inline void load_tile(const Tiles<T>& tiles, const int64_t block, const int64_t tile, Vec<T> (&x)[GIVEN][GIVEN]) {
  const T* from = tiles.at(0, block, tile);
  x[0][0] = x[GIVEN - 1][GIVEN - 1] = Vec<T>{};
#pragma GCC unroll 32
  for (int slot = 0; slot < SLOTS; ++slot) x[(slot + 1) / GIVEN][(slot + 1) % GIVEN] = load(from + slot * tiles.slot_step());
}

template <typename T>
inline void store_tile(const Vec<T> (&x)[GIVEN][GIVEN], const Tiles<T>& tiles, const int64_t block, const int64_t tile) {
  T* to = tiles.at(0, block, tile);
#pragma GCC unroll 32
  for (int slot = 0; slot < SLOTS; ++slot) store(to + slot * tiles.slot_step(), x[(slot + 1) / GIVEN][(slot + 1) % GIVEN]);
}

// Call `one(block, tile, corner)` for all tiles of a strip; the corner is that of the tile in a plane.
template <typename T, typename Function>
inline void for_tiles(const Planes<T>& planes, const int k, int64_t tile, const Function& one) {
  for (int64_t row = 0; row < planes.rows / SIDE; ++row)
    for (int64_t column = 0; column < planes.columns / SIDE; ++column, ++tile)
      for (int64_t block = 0; block < planes.blocks; ++block)
        one(block, tile, planes.at(k, SIDE * row, SIDE * column) + block * LANES);
}

// In a plane: places, SIZE x SIZE of them for a tile, to slots.
template <const auto& MATRIX, bool TRANSPOSED, typename T>
void to_tiles(const Planes<T>& planes, const int k, const Tiles<T>& tiles, const int64_t first) {
  constexpr int SIZE = TRANSPOSED ? SIDE : GIVEN;
  const int64_t right = planes.blocks * LANES, down = planes.columns * right;
  for_tiles(planes, k, first, [&](const int64_t block, const int64_t tile, const T* from) {
    Vec<T> d[SIZE][SIZE], x[GIVEN][GIVEN];
#pragma GCC unroll 5
    for (int i = 0; i < SIZE; ++i)
#pragma GCC unroll 5
      for (int j = 0; j < SIZE; ++j) d[i][j] = load(from + i * down + j * right);
    winograd::square<MATRIX, TRANSPOSED>(d, x);
    store_tile<T>(x, tiles, block, tile);
  });
}

// In a plane: slots to places, which are added up where tiles overlap.
template <const auto& MATRIX, bool TRANSPOSED, typename T>
void from_tiles(const Tiles<T>& tiles, const int64_t first, const Planes<T>& planes, const int k) {
  constexpr int SIZE = TRANSPOSED ? GIVEN : SIDE;
  const int64_t right = planes.blocks * LANES, down = planes.columns * right;
  if (SIZE > SIDE) std::fill_n(planes.at(k, 0, 0), planes.step(), T(0));
  for_tiles(planes, k, first, [&](const int64_t block, const int64_t tile, T* to) {
    Vec<T> x[GIVEN][GIVEN], d[SIZE][SIZE];
    load_tile<T>(tiles, block, tile, x);
    winograd::square<MATRIX, TRANSPOSED>(x, d);
#pragma GCC unroll 5
    for (int i = 0; i < SIZE; ++i)
#pragma GCC unroll 5
      for (int j = 0; j < SIZE; ++j) {
        T* place = to + i * down + j * right;
        store(place, SIZE > SIDE ? Vec<T>(load(place) + d[i][j]) : d[i][j]);
      }
  });
}

// A weight (O, C, 7 or 21) from given channels to results; backwards from results to given channels. Which tap is where in
// a kernel of 3 x 3 is said by `taps`; those from HEXAGON on are none.
template <typename T>
struct Weight {
  T* data;
  at::IntArrayRef taps;
  int64_t channels, results, by_channel, by_result;

  Weight(const at::Tensor& weight, const at::IntArrayRef taps, const bool backwards)
      : data(const_cast<T*>(weight.const_data_ptr<T>())),
        taps(taps),
        channels(weight.size(backwards ? 0 : 1)),
        results(weight.size(backwards ? 1 : 0)),
        by_channel(weight.stride(backwards ? 0 : 1)),
        by_result(weight.stride(backwards ? 1 : 0)) {}

  int64_t blocks() const { return (results + LANES - 1) / LANES; }
  int64_t in_block(const int64_t block) const { return std::min(LANES, results - block * LANES); }
  T* at(const int64_t channel, const int64_t result) const { return data + channel * by_channel + result * by_result; }
};

// What tiles are multiplied with, and gradients of it: [plane, slot][VECTORS blocks of results][channel][vector], so that
// every pass over channels reads memory that lies together. One vector more a slot: with a step that is a power of two those of
// all slots, which are written together, would lie in one set of the cache.
template <typename T>
struct Factors {
  at::Tensor memory;  // (parts, size)
  T* data;
  int64_t channels, blocks, size;

  Factors(const at::Tensor& like, const Weight<T>& weight, const int64_t planes, const int64_t parts = 1)
      : channels(weight.channels), blocks(weight.blocks()), size(planes * SLOTS * (channels * blocks + 1) * LANES) {
    memory = like.new_empty({parts, size});
    data = memory.mutable_data_ptr<T>();
  }
  // Vectors from a block on that are multiplied together: the last may be alone.
  int64_t together(const int64_t block) const { return std::min<int64_t>(VECTORS<T>, blocks - block / VECTORS<T> * VECTORS<T>); }
  T* at(const int64_t slot, const int64_t channel, const int64_t block) const {
    const int64_t first = block / VECTORS<T> * VECTORS<T>;
    return data + (slot * (blocks * channels + 1) + first * channels + channel * together(block) + block - first) * LANES;
  }
};

// Taps to factors: first along the hypotheses, then in the plane.
template <typename T, int F>
Factors<T> make_factors(const at::Tensor& tensor, const at::IntArrayRef taps, const bool backwards) {
  constexpr int DEPTH = TAP_HYPOTHESES<F>;
  const Weight<T> weight(tensor, taps, backwards);
  const Factors<T> factors(tensor, weight, F);
  at::parallel_for(0, weight.channels * weight.blocks(), 16, [&](const int64_t begin, const int64_t end) {
    for (int64_t task = begin; task < end; ++task) {
      const int64_t channel = task / weight.blocks(), block = task % weight.blocks();
      Vec<T> tap[HEXAGON][DEPTH]{}, by_plane[HEXAGON][F];
      for (int64_t lane = 0; lane < weight.in_block(block); ++lane) {
        const T* from = weight.at(channel, block * LANES + lane);
        for (int t = 0; t < HEXAGON; ++t)
          for (int k = 0; k < DEPTH; ++k) tap[t][k][lane] = from[k * HEXAGON + t];
      }
      for (int t = 0; t < HEXAGON; ++t) winograd::line<winograd::TAPS_6, false>(tap[t], by_plane[t]);
      for (int k = 0; k < F; ++k) {
        Vec<T> kernel[SIDE][SIDE]{}, x[GIVEN][GIVEN];
        for (int i = 0; i < SIDE * SIDE; ++i)
          if (weight.taps[i] < HEXAGON) kernel[i / SIDE][i % SIDE] = by_plane[weight.taps[i]][k];
        winograd::square<winograd::TAPS_5, false>(kernel, x);
        for (int slot = 0; slot < SLOTS; ++slot)
          store(factors.at(k * SLOTS + slot, channel, block), x[(slot + 1) / GIVEN][(slot + 1) % GIVEN]);
      }
    }
  });
  return factors;
}

// The adjoint of `make_factors`, of the sum of several parts, always in the same order.
template <typename T, int F>
void write_weight_gradient(const Factors<T>& parts, const Weight<T>& grad) {
  constexpr int DEPTH = TAP_HYPOTHESES<F>;
  const int64_t number = parts.memory.size(0);
  at::parallel_for(0, grad.channels * grad.blocks(), 16, [&](const int64_t begin, const int64_t end) {
    for (int64_t task = begin; task < end; ++task) {
      const int64_t channel = task / grad.blocks(), block = task % grad.blocks();
      Vec<T> tap[HEXAGON][DEPTH], by_plane[HEXAGON][F];
      for (int k = 0; k < F; ++k) {
        Vec<T> kernel[SIDE][SIDE], x[GIVEN][GIVEN]{};
        for (int slot = 0; slot < SLOTS; ++slot) {
          const T* from = parts.at(k * SLOTS + slot, channel, block);
          for (int64_t part = 0; part < number; ++part) x[(slot + 1) / GIVEN][(slot + 1) % GIVEN] += load(from + part * parts.size);
        }
        winograd::square<winograd::TAPS_5, true>(x, kernel);
        for (int i = 0; i < SIDE * SIDE; ++i)
          if (grad.taps[i] < HEXAGON) by_plane[grad.taps[i]][k] = kernel[i / SIDE][i % SIDE];
      }
      for (int t = 0; t < HEXAGON; ++t) winograd::line<winograd::TAPS_6, true>(by_plane[t], tap[t]);
      for (int64_t lane = 0; lane < grad.in_block(block); ++lane) {
        T* to = grad.at(channel, block * LANES + lane);
        for (int t = 0; t < HEXAGON; ++t)
          for (int k = 0; k < DEPTH; ++k) to[k * HEXAGON + t] = tap[t][k][lane];
      }
    }
  });
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

// All products of tiles with the factors of plane k.
template <typename T>
void multiply(const Tiles<T>& given, const Factors<T>& factors, const int k, const Tiles<T>& made) {
  const int64_t parts = (given.number + TOGETHER<T> - 1) / TOGETHER<T>;
  for (int64_t slot = 0; slot < SLOTS; ++slot) {
    for (int64_t block = 0; block < made.blocks; block += VECTORS<T>) {
      const bool full = factors.together(block) == VECTORS<T>;
      const auto some = full ? multiply_some<T, TOGETHER<T>, VECTORS<T>> : multiply_some<T, TOGETHER<T>, 1>;
      for (int64_t part = 0; part < parts; ++part) {  // as even as can be
        const int64_t first = part * given.number / parts, last = (part + 1) * given.number / parts;
        some(last - first, given.at(slot, 0, first), factors.channels, given.block_step(),
             factors.at(k * SLOTS + slot, 0, block), factors.together(block) * LANES, made.at(slot, block, first),
             made.block_step());
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

// The gradient of the factors of plane k.
template <typename T>
void add_factor_gradient(const Tiles<T>& given, const Tiles<T>& grad, const int k, const Factors<T>& totals) {
  for (int64_t slot = 0; slot < SLOTS; ++slot) {
    for (int64_t channel = 0; channel < totals.channels; channel += CHANNELS<T>) {
      const int64_t count = std::min<int64_t>(CHANNELS<T>, totals.channels - channel);
      const T* from = given.at(slot, channel / LANES, 0) + channel % LANES;
      for (int64_t block = 0; block < grad.blocks; block += VECTORS<T>) {
        const bool full = totals.together(block) == VECTORS<T>;
        (full ? add_sum_over_tiles<T, VECTORS<T>> : add_sum_over_tiles<T, 1>)(
            from, grad.at(slot, block, 0), grad.block_step(), given.number, count,
            totals.at(k * SLOTS + slot, channel, block), totals.together(block) * LANES);
      }
    }
  }
}

// Call `one(strips)` in parallel for a few of `number` strips at a time, about TILES tiles, but no thread has more than its share.
template <typename At, typename Function>
void for_strips(const Grid& grid, const int64_t number, const At& at, const Function& one) {
  const int64_t in_cache = TILES / (grid.most_rows() * grid.columns), shared = number / at::get_num_threads();
  const int64_t together = std::max<int64_t>(1, std::min(in_cache, shared)), hands = (number + together - 1) / together;
  at::parallel_for(0, hands, 1, [&](const int64_t begin, const int64_t end) {
    for (int64_t hand = begin; hand < end; ++hand) {
      std::vector<Strip> strips;
      for (int64_t i = hand * number / hands; i < (hand + 1) * number / hands; ++i) strips.push_back(at(i));
      one(std::move(strips));
    }
  });
}

template <typename T, int F>
void forward(const Volumes<T>& given, const Scaling<T>& scaling, const Factors<T>& factors, const T* bias, const bool rectify,
             const int64_t border, const Volumes<T>& results) {
  const Grid grid(results, MADE<F>);
  for_strips(grid, grid.size(), [&](const int64_t i) { return grid.strip(i); }, [&](std::vector<Strip> strips) {
    const Hand<T, F> hand(grid, std::move(strips), given.blocks, results.blocks);
    const Tiles<T> tiles = hand.given_tiles(), products = hand.result_tiles();
    for (const Strip& strip : hand.strips) read_given<T, F>(given, scaling, strip, border, hand.given(strip));
    for (int k = 0; k < F; ++k) {
      for (const Strip& strip : hand.strips) to_tiles<winograd::GIVEN_5, false>(hand.given(strip), k, tiles, strip.tile);
      multiply(tiles, factors, k, products);
      for (const Strip& strip : hand.strips) from_tiles<winograd::RESULTS_5, false>(products, strip.tile, hand.results(strip), k);
    }
    for (const Strip& strip : hand.strips) write_results<T, F>(hand.results(strip), strip, bias, rectify, results);
  });
}

// The adjoint with respect to what is given, added to `grad_given`. The factors are those of the weight backwards.
template <typename T, int F>
void backward_given(const Volumes<T>& grad, const Factors<T>& factors, const int64_t border, const Volumes<T>& grad_given) {
  const Grid grid(grad, MADE<F>);
  // Neighbouring strips and neighbouring groups of hypotheses add to the same places, those after next do not: even ones
  // and odd ones take turns. So do rectangles that add to the same vertices.
  const int64_t charts = grad_given.places ? CHARTS : 1;
  for (int64_t turn = 0; turn < 4 * charts; ++turn) {
    const int64_t odd_part = turn % 2, odd_group = turn / 2 % 2, chart = turn / 4;
    const int64_t parts = (grid.parts + 1 - odd_part) / 2, groups = (grid.groups + 1 - odd_group) / 2;
    const auto at = [&](const int64_t i) {
      return grid.strip(i / parts / groups * charts + chart, 2 * (i / parts % groups) + odd_group, 2 * (i % parts) + odd_part);
    };
    for_strips(grid, grid.batch / charts * groups * parts, at, [&](std::vector<Strip> strips) {
      const Hand<T, F> hand(grid, std::move(strips), grad_given.blocks, grad.blocks);
      const Tiles<T> tiles = hand.given_tiles(), products = hand.result_tiles();
      for (const Strip& strip : hand.strips) read_gradients<T, F>(grad, strip, hand.results(strip));
      for (int k = 0; k < F; ++k) {
        for (const Strip& strip : hand.strips) to_tiles<winograd::RESULTS_5, true>(hand.results(strip), k, products, strip.tile);
        multiply(products, factors, k, tiles);
        for (const Strip& strip : hand.strips) from_tiles<winograd::GIVEN_5, true>(tiles, strip.tile, hand.given(strip), k);
      }
      for (const Strip& strip : hand.strips) add_to_given<T, F>(hand.given(strip), strip, border, grad_given);
    });
  }
}

// The adjoint with respect to the factors, added to parts of `totals`, one for each thread.
template <typename T, int F>
void backward_factors(const Volumes<T>& given, const Scaling<T>& scaling, const Volumes<T>& grad, const int64_t border,
                      const Factors<T>& totals) {
  const Grid grid(grad, MADE<F>);
  const int64_t parts = totals.memory.size(0);
  const int64_t together = std::max<int64_t>(1, 3 * TILES / (grid.most_rows() * grid.columns));
  at::parallel_for(0, parts, 1, [&](const int64_t begin, const int64_t end) {
    for (int64_t part = begin; part < end; ++part) {
      Factors<T> own = totals;
      own.data += part * totals.size;
      const int64_t last = (part + 1) * grid.size() / parts;
      for (int64_t first = part * grid.size() / parts; first < last; first += together) {
        std::vector<Strip> strips;
        for (int64_t i = first; i < std::min(first + together, last); ++i) strips.push_back(grid.strip(i));
        const Hand<T, F> hand(grid, std::move(strips), given.blocks, grad.blocks);
        const Tiles<T> tiles = hand.given_tiles(), upstream = hand.result_tiles();
        for (const Strip& strip : hand.strips) {
          read_given<T, F>(given, scaling, strip, border, hand.given(strip));
          read_gradients<T, F>(grad, strip, hand.results(strip));
        }
        for (int k = 0; k < F; ++k) {
          for (const Strip& strip : hand.strips) {
            to_tiles<winograd::GIVEN_5, false>(hand.given(strip), k, tiles, strip.tile);
            to_tiles<winograd::RESULTS_5, true>(hand.results(strip), k, upstream, strip.tile);
          }
          add_factor_gradient(tiles, upstream, k, own);
        }
      }
    }
  });
}

// Check what belongs together and return whether hypotheses go through Winograd's transforms.
bool check(const at::Tensor& given, const at::Tensor& weight, const at::IntArrayRef taps, const at::Tensor& result,
           const int64_t border, const std::optional<at::Tensor>& places) {
  TORCH_CHECK(given.dim() == 5 && result.dim() == 5, "expected volumes (B, D, h, w, C)");
  TORCH_CHECK(given.scalar_type() == result.scalar_type() && given.scalar_type() == weight.scalar_type(),
              "expected one precision, got ", given.scalar_type(), ", ", result.scalar_type(), " and ", weight.scalar_type());
  TORCH_CHECK(!places || (places->dim() == 3 && places->size(0) == CHARTS && places->is_contiguous() && places->numel() &&
                          places->scalar_type() == at::kInt),
              "places: expected int32 (5, h, w)");
  const int64_t height = places ? places->size(1) : given.size(2), width = places ? places->size(2) : given.size(3);
  TORCH_CHECK((border == 0 || border == 1) && given.size(0) * (places ? CHARTS : 1) == result.size(0) &&
                  given.size(1) == result.size(1) && height == result.size(2) + 2 * border && width == result.size(3) + 2 * border,
              "given values and results do not fit: ", given.sizes(), " and ", result.sizes());
  TORCH_CHECK(weight.dim() == 3 && weight.stride(2) == 1 && weight.size(0) == result.size(4) && weight.size(1) == given.size(4) &&
                  (weight.size(2) == 3 * HEXAGON || (weight.size(2) == HEXAGON && given.size(1) == 1)),
              "weight: expected (", result.size(4), ", ", given.size(4), ", 21, or 7 for images), got ", weight.sizes());
  // Two products of a tile are left out because these two corners are empty.
  TORCH_CHECK(taps.size() == SIDE * SIDE && taps[0] == HEXAGON && taps[8] == HEXAGON, "taps: expected nine without two corners");
  for (const int64_t tap : taps) TORCH_CHECK(tap >= 0 && tap <= HEXAGON, "taps: expected 0 to 7, got ", taps);
  return weight.size(2) != HEXAGON;
}

// Call `one(planes)` for six planes of factors or for one, a number that the compiler knows.
template <typename Function>
void for_planes(const bool transformed, const Function& one) {
  transformed ? one(std::integral_constant<int, 6>()) : one(std::integral_constant<int, 1>());
}

void hex_convolve(const at::Tensor& given, const at::Tensor& weight, const at::IntArrayRef taps,
                  const std::optional<at::Tensor>& bias, const bool rectify, const int64_t border, at::Tensor result,
                  const std::optional<at::Tensor>& places, const std::optional<at::Tensor>& factor,
                  const std::optional<at::Tensor>& offset) {
  const bool transformed = check(given, weight, taps, result, border, places);
  TORCH_CHECK(!bias || (bias->is_contiguous() && bias->numel() == result.size(4) && bias->scalar_type() == given.scalar_type()),
              "bias: expected ", result.size(4), " values");
  AT_DISPATCH_FLOATING_TYPES(given.scalar_type(), "hex_convolve", [&] {
    const Volumes<scalar_t> from(given, "given", places), to(result, "result");
    const Scaling<scalar_t> scaling(factor, offset, from);
    const scalar_t* shift = bias ? bias->const_data_ptr<scalar_t>() : nullptr;
    for_planes(transformed, [&](auto planes) {
      constexpr int F = decltype(planes)::value;
      forward<scalar_t, F>(from, scaling, make_factors<scalar_t, F>(weight, taps, false), shift, rectify, border, to);
    });
  });
}

void hex_convolve_backward_given(const at::Tensor& grad, const at::Tensor& weight, const at::IntArrayRef taps,
                                 const int64_t border, at::Tensor grad_given, const std::optional<at::Tensor>& places) {
  const bool transformed = check(grad_given, weight, taps, grad, border, places);
  AT_DISPATCH_FLOATING_TYPES(grad.scalar_type(), "hex_convolve_backward_given", [&] {
    const Volumes<scalar_t> from(grad, "grad"), to(grad_given, "grad_given", places);
    for_planes(transformed, [&](auto planes) {
      constexpr int F = decltype(planes)::value;
      backward_given<scalar_t, F>(from, make_factors<scalar_t, F>(weight, taps, true), border, to);
    });
  });
}

void hex_convolve_backward_weight(const at::Tensor& given, const at::Tensor& grad, const at::IntArrayRef taps,
                                  const int64_t border, at::Tensor grad_weight, const std::optional<at::Tensor>& places,
                                  const std::optional<at::Tensor>& factor, const std::optional<at::Tensor>& offset) {
  const bool transformed = check(given, grad_weight, taps, grad, border, places);
  AT_DISPATCH_FLOATING_TYPES(given.scalar_type(), "hex_convolve_backward_weight", [&] {
    const Volumes<scalar_t> from(given, "given", places), upstream(grad, "grad");
    const Scaling<scalar_t> scaling(factor, offset, from);
    for_planes(transformed, [&](auto planes) {
      constexpr int F = decltype(planes)::value;
      const Weight<scalar_t> to(grad_weight, taps, false);
      const Factors<scalar_t> totals(grad, to, F, at::get_num_threads());
      totals.memory.zero_();
      backward_factors<scalar_t, F>(from, scaling, upstream, border, totals);
      write_weight_gradient<scalar_t, F>(totals, to);
    });
  });
}

}  // namespace

TORCH_LIBRARY_FRAGMENT(sphericalvision, library) {
  library.def("hex_convolve(Tensor given, Tensor weight, int[] taps, Tensor? bias, bool rectify, int border, "
              "Tensor(a!) result, Tensor? places=None, Tensor? factor=None, Tensor? offset=None) -> ()");
  library.def("hex_convolve_backward_given(Tensor grad, Tensor weight, int[] taps, int border, Tensor(a!) grad_given, "
              "Tensor? places=None) -> ()");
  library.def("hex_convolve_backward_weight(Tensor given, Tensor grad, int[] taps, int border, Tensor(a!) grad_weight, "
              "Tensor? places=None, Tensor? factor=None, Tensor? offset=None) -> ()");
}

TORCH_LIBRARY_IMPL(sphericalvision, CPU, library) {
  library.impl("hex_convolve", &hex_convolve);
  library.impl("hex_convolve_backward_given", &hex_convolve_backward_given);
  library.impl("hex_convolve_backward_weight", &hex_convolve_backward_weight);
}
