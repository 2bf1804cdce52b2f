// SPDX-License-Identifier: Apache-2.0
// Tensors of volumes, and places outside them.

#pragma once

#include <ATen/core/Tensor.h>

#include <algorithm>
#include <optional>

#include "lanes.h"

namespace volumes {

using lanes::LANES;

constexpr int64_t CHARTS = 5;  // rectangles of one kind

// Volumes (B, D, h, w, C), channels next to each other; images have D = 1. Or values at vertices, (B, D, 1, V, C), which
// `places`, the numbers of vertices (5, h, w), lay out as five rectangles a sample: these are then never written.
template <typename T>
struct Volumes {
  T* data;
  const int32_t* places = nullptr;
  int64_t batch, depth, height, width, channels, blocks;
  int64_t next, deep, down, right;

  Volumes(const at::Tensor& tensor, const char* name, const std::optional<at::Tensor>& laid_out = {})
      : data(const_cast<T*>(tensor.const_data_ptr<T>())),
        batch(tensor.size(0)),
        depth(tensor.size(1)),
        height(tensor.size(2)),
        width(tensor.size(3)),
        channels(tensor.size(4)),
        blocks((channels + LANES - 1) / LANES),
        next(tensor.stride(0)),
        deep(tensor.stride(1)),
        down(tensor.stride(2)),
        right(tensor.stride(3)) {
    TORCH_CHECK(tensor.dim() == 5 && (tensor.stride(4) == 1 || channels == 1), name,
                ": expected (B, D, h, w, C) whose channels lie together, got ", tensor.sizes());
    if (!laid_out) return;
    places = laid_out->const_data_ptr<int32_t>();
    const auto [least, most] = std::minmax_element(places, places + laid_out->numel());
    TORCH_CHECK(height == 1 && *least >= 0 && *most < width, "places: expected numbers of ", width, " vertices");
    batch *= CHARTS, height = laid_out->size(1), width = laid_out->size(2);
  }

  T* at(const int64_t b, const int64_t d, const int64_t y, const int64_t x, const int64_t block) const {
    const int64_t place = places ? b / CHARTS * next + places[(b % CHARTS * height + y) * width + x] * right
                                 : b * next + y * down + x * right;
    return data + d * deep + place + block * LANES;
  }

  // Channels in a block; the last one may have fewer.
  int64_t in_block(const int64_t block) const { return std::min(LANES, channels - block * LANES); }
};

// Factors and offsets of values, (B or 1, C), by which they are normalised while they are read: cheaper than to write them, and
// nobody needs to keep them. Without a factor values are as they are.
template <typename T>
struct Scaling {
  const T *factor = nullptr, *offset = nullptr;
  int64_t samples = 1, batch, channels;

  Scaling(const std::optional<at::Tensor>& factors, const std::optional<at::Tensor>& offsets, const Volumes<T>& values)
      : batch(values.batch), channels(values.channels) {
    if (!factors) return;
    for (const at::Tensor& table : {*factors, offsets.value()})
      TORCH_CHECK(table.dim() == 2 && table.is_contiguous() && table.size(1) == channels && batch % table.size(0) == 0 &&
                      table.sizes() == factors->sizes(),
                  "factor and offset: expected (samples or 1, ", channels, "), got ", table.sizes());
    factor = factors->const_data_ptr<T>(), offset = offsets->const_data_ptr<T>(), samples = factors->size(0);
  }

  lanes::Vec<T> scaled(const lanes::Vec<T>& value, const int64_t b, const int64_t block, const int64_t count) const {
    const int64_t at = b * samples / batch * channels + block * LANES;
    return value * lanes::load(factor + at, count) + lanes::load(offset + at, count);
  }
};

// What to do with a row or column outside: it is there (the border was given), or the outermost one is repeated.
inline int64_t inside(const int64_t place, const int64_t size) { return std::clamp<int64_t>(place, 0, size - 1); }

}  // namespace volumes
