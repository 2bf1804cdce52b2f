// SPDX-License-Identifier: Apache-2.0
// The sums around the products of winograd_cubes.py, which says what they are and has them in PyTorch, too.

#include <ATen/Parallel.h>
#include <ATen/core/Tensor.h>
#include <torch/library.h>

#include <algorithm>
#include <cstring>
#include <optional>

#include "winograd_lines.h"

namespace {

constexpr int AHEAD = 4;  // lines of memory are asked for so many places of a tile before they are needed

using Eight = float __attribute__((vector_size(32)));

template <typename V>
inline V load(const float* from) {
  V value;
  std::memcpy(&value, from, sizeof(V));
  return value;
}

template <typename V>
inline void store(float* to, const V value) {
  std::memcpy(to, &value, sizeof(V));
}

// Tiles of volumes (B, D, h, w, C), whose channels lie together, and where their values go: flat, (6 * number, places, C).
struct Grid {
  int64_t depth, rows, columns, lines;  // how many tiles; a line is a row of them
  int64_t height, width, channels;
  int64_t next, deep, down, right;  // strides of the volumes
  int64_t number, places;
  const int64_t* slots;  // for each of 36 places in a plane, which of `number` it is, or -1

  // With `border` more values than results in each direction.
  Grid(const at::Tensor& volumes, const at::Tensor& flat, const at::Tensor& slot_of, const int64_t border)
      : depth((volumes.size(1) - border) / 4),
        rows((volumes.size(2) - border + 3) / 4),
        columns((volumes.size(3) - border + 3) / 4),
        lines(volumes.size(0) * depth * rows),
        height(volumes.size(2)),
        width(volumes.size(3)),
        channels(volumes.size(4)),
        next(volumes.stride(0)),
        deep(volumes.stride(1)),
        down(volumes.stride(2)),
        right(volumes.stride(3)),
        number(flat.size(0) / 6),
        places(flat.size(1)),
        slots(slot_of.const_data_ptr<int64_t>()) {
    TORCH_CHECK(volumes.dim() == 5 && volumes.stride(4) == 1 && volumes.scalar_type() == at::kFloat,
                "volumes: expected float32 (B, D, h, w, C) whose channels lie together, got ", volumes.sizes());
    TORCH_CHECK(flat.is_contiguous() && flat.scalar_type() == at::kFloat && flat.size(1) == lines * columns &&
                    flat.size(2) == channels,
                "expected float32 (6 * number, ", lines * columns, ", ", channels, "), got ", flat.sizes());
    TORCH_CHECK(slot_of.is_contiguous() && slot_of.numel() == 36 && *std::max_element(slots, slots + 36) < number,
                "slots: expected 36 numbers below ", number);
  }

  // Offset of the first value of a line in the volumes.
  int64_t start(const int64_t line) const {
    const int64_t slab = line / rows;
    return slab / depth * next + slab % depth * 4 * deep + line % rows * 4 * down;
  }

  // Offset in what is flat of the first of six vectors for a place of the plane; the others follow by `step()`.
  int64_t at(const int k, const int64_t place, const int64_t channel) const {
    return (slots[k] * places + place) * channels + channel;
  }

  int64_t step() const { return number * places * channels; }
};

// Ask for six lines of memory that come soon: they are too many streams for a processor to foresee.
template <int write>
inline void prefetch(const float* from, const int64_t step) {
#if defined(__GNUC__)
  for (int64_t d = 0; d < 6; ++d) __builtin_prefetch(from + d * step, write);
#endif
}

// W vectors V of channels at a time.
template <typename V, int W>
void tiles_of_line(const Grid grid, const float* volumes, float* tiles, const int64_t line) {
  constexpr int64_t size = sizeof(V) / sizeof(float);
  const int64_t step = grid.step(), *slots = grid.slots;
  const float* given = volumes + grid.start(line);
  const int64_t below = grid.height - 1 - line % grid.rows * 4;
  V x[W][6][6][6], in[6], out[6];
  for (int64_t column = 0; column < grid.columns; ++column) {
    const int64_t place = line * grid.columns + column;
    for (int64_t block = 0; block < grid.channels; block += W * size) {
      const int64_t channel = std::min(block, grid.channels - W * size);  // the last block may do some channels again
      for (int64_t d = 0; d < 6; ++d) {
        for (int64_t i = 0; i < 6; ++i) {
          const float* row = given + d * grid.deep + std::min(i, below) * grid.down + channel;
          for (int w = 0; w < W; ++w) {
            for (int64_t j = 0; j < 6; ++j)
              in[j] = load<V>(row + std::min(4 * column + j, grid.width - 1) * grid.right + w * size);
            winograd::to_factors<float>(in, x[w][d][i]);
          }
        }
        for (int w = 0; w < W; ++w) {
          for (int j = 0; j < 6; ++j) {
            for (int i = 0; i < 6; ++i) in[i] = x[w][d][i][j];
            winograd::to_factors<float>(in, out);
            for (int i = 0; i < 6; ++i) x[w][d][i][j] = out[i];
          }
        }
      }
      for (int k = 0; k < 36; ++k) {
        if (k + AHEAD < 36 && slots[k + AHEAD] >= 0) prefetch<1>(tiles + grid.at(k + AHEAD, place, channel), step);
        if (slots[k] < 0) continue;
        float* to = tiles + grid.at(k, place, channel);
        for (int w = 0; w < W; ++w) {
          for (int d = 0; d < 6; ++d) in[d] = x[w][d][k / 6][k % 6];
          winograd::to_factors<float>(in, out);
          for (int64_t d = 0; d < 6; ++d) store(to + d * step + w * size, out[d]);
        }
      }
    }
  }
}

template <typename V, int W>
void results_of_line(const Grid grid, const float* products, const float* bias, const bool rectify, float* volumes,
                     const int64_t line) {
  constexpr int64_t size = sizeof(V) / sizeof(float);
  const int64_t step = grid.step(), *slots = grid.slots;
  float* result = volumes + grid.start(line);
  const int64_t high = std::min<int64_t>(4, grid.height - line % grid.rows * 4);
  V x[W][4][6][6], rows[4][6], in[6], out[4];
  for (int64_t column = 0; column < grid.columns; ++column) {
    const int64_t place = line * grid.columns + column, wide = std::min<int64_t>(4, grid.width - 4 * column);
    for (int64_t block = 0; block < grid.channels; block += W * size) {
      const int64_t channel = std::min(block, grid.channels - W * size);
      for (int k = 0; k < 36; ++k) {
        if (k + AHEAD < 36 && slots[k + AHEAD] >= 0) prefetch<0>(products + grid.at(k + AHEAD, place, channel), step);
        const float* from = products + (slots[k] < 0 ? 0 : grid.at(k, place, channel));
        for (int w = 0; w < W; ++w) {
          for (int64_t d = 0; d < 6; ++d) in[d] = slots[k] < 0 ? V{} : load<V>(from + d * step + w * size);
          winograd::to_results<float>(in, out);
          for (int d = 0; d < 4; ++d) x[w][d][k / 6][k % 6] = out[d];
        }
      }
      for (int64_t d = 0; d < 4; ++d) {
        for (int w = 0; w < W; ++w) {
          const V shift = bias ? load<V>(bias + channel + w * size) : V{};
          for (int j = 0; j < 6; ++j) {
            for (int i = 0; i < 6; ++i) in[i] = x[w][d][i][j];
            winograd::to_results<float>(in, out);
            for (int i = 0; i < 4; ++i) rows[i][j] = out[i];
          }
          for (int64_t i = 0; i < high; ++i) {
            winograd::to_results<float>(rows[i], out);
            float* row = result + d * grid.deep + i * grid.down + 4 * column * grid.right + channel + w * size;
            for (int64_t j = 0; j < wide; ++j) {
              V value = out[j] + shift;
              if (rectify) value = value > 0.0f ? value : V{};
              store(row + j * grid.right, value);
            }
          }
        }
      }
    }
  }
}

// Call `one` for every line, with vectors that the channels fill.
template <typename F>
void for_lines(const Grid& grid, const F& one) {
  at::parallel_for(0, grid.lines, 1, [&](const int64_t first, const int64_t last) {
    for (int64_t line = first; line < last; ++line) {
      if (grid.channels >= 16) {
        one.template operator()<Eight, 2>(line);
      } else if (grid.channels >= 8) {
        one.template operator()<Eight, 1>(line);
      } else {
        one.template operator()<float, 1>(line);
      }
    }
  });
}

void winograd_tiles(const at::Tensor& padded, const at::Tensor& slots, at::Tensor tiles) {
  const Grid grid(padded, tiles, slots, 2);
  const float* from = padded.const_data_ptr<float>();
  float* to = tiles.mutable_data_ptr<float>();
  for_lines(grid, [&]<typename V, int W>(const int64_t line) { tiles_of_line<V, W>(grid, from, to, line); });
}

void winograd_results(const at::Tensor& products, const at::Tensor& slots, const std::optional<at::Tensor>& bias,
                      const bool rectify, at::Tensor result) {
  const Grid grid(result, products, slots, 0);
  TORCH_CHECK(!bias || (bias->is_contiguous() && bias->scalar_type() == at::kFloat && bias->numel() == grid.channels),
              "bias: expected ", grid.channels, " values, float32");
  const float *from = products.const_data_ptr<float>(), *shift = bias ? bias->const_data_ptr<float>() : nullptr;
  float* to = result.mutable_data_ptr<float>();
  for_lines(grid, [&]<typename V, int W>(const int64_t line) {
    results_of_line<V, W>(grid, from, shift, rectify, to, line);
  });
}

}  // namespace

TORCH_LIBRARY_FRAGMENT(sphericalvision, library) {
  library.def("winograd_tiles(Tensor padded, Tensor slots, Tensor(a!) tiles) -> ()");
  library.def("winograd_results(Tensor products, Tensor slots, Tensor? bias, bool rectify, Tensor(a!) result) -> ()");
}

TORCH_LIBRARY_IMPL(sphericalvision, CPU, library) {
  library.impl("winograd_tiles", &winograd_tiles);
  library.impl("winograd_results", &winograd_results);
}
