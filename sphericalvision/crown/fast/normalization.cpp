// SPDX-License-Identifier: Apache-2.0
// Normalisation and the ReLU after it in two passes over memory each way, where layers of torch take nine and sixteen.
//
// Values are (B, P, C), channels next to each other. Statistics and factors are (B or 1, C): of each sample, or of all.

#include <ATen/Parallel.h>
#include <ATen/core/Tensor.h>
#include <ATen/Dispatch.h>
#include <torch/library.h>

#include <algorithm>

#include "lanes.h"

namespace {

using lanes::LANES, lanes::load, lanes::store, lanes::Vec;

constexpr int64_t CHUNK = 128;  // places at a time, which stay in the first-level cache

struct Shape {
  int64_t batch, places, channels, chunks;

  explicit Shape(const at::Tensor& values)
      : batch(values.size(0)), places(values.size(1)), channels(values.size(2)), chunks((places + CHUNK - 1) / CHUNK) {}

  int64_t begin(const int64_t chunk) const { return chunk * CHUNK; }
  int64_t end(const int64_t chunk) const { return std::min(places, (chunk + 1) * CHUNK); }
};

void check(const at::Tensor& values, const at::Tensor& like) {
  TORCH_CHECK(values.dim() == 3 && values.is_contiguous() && values.sizes() == like.sizes() &&
                  values.scalar_type() == like.scalar_type(),
              "expected contiguous values (B, P, C) of one size and precision, got ", values.sizes(), " and ", like.sizes());
}

// Rows of a table (B or 1, C).
template <typename T>
const T* row_of(const at::Tensor& table, const Shape& shape, const int64_t sample) {
  return table.const_data_ptr<T>() + (table.size(0) == 1 ? 0 : sample) * shape.channels;
}

void check_table(const at::Tensor& table, const at::Tensor& values) {
  TORCH_CHECK(table.is_contiguous() && table.dim() == 2 && table.size(1) == values.size(2) &&
                  (table.size(0) == 1 || table.size(0) == values.size(0)) && table.scalar_type() == values.scalar_type(),
              "expected a table (B or 1, C) for values ", values.sizes(), ", got ", table.sizes());
}

// Call `one(sample, chunk, block, count)` for all blocks of sixteen channels or fewer.
template <typename F>
void for_chunks(const Shape& shape, const F& one) {
  at::parallel_for(0, shape.batch * shape.chunks, 64, [&](const int64_t begin, const int64_t end) {
    for (int64_t task = begin; task < end; ++task)
      for (int64_t channel = 0; channel < shape.channels; channel += LANES)
        one(task / shape.chunks, task % shape.chunks, channel, std::min(LANES, shape.channels - channel));
  });
}

// Sums of each chunk (B, chunks, C), and of squared distances from the chunk's own mean, which lose nothing to rounding;
// Chan, Golub and LeVeque's way to put both together is a few small sums, left to who calls.
void chunk_moments(const at::Tensor& values, at::Tensor sums, at::Tensor squares) {
  check(values, values);
  const Shape shape(values);
  AT_DISPATCH_FLOATING_TYPES(values.scalar_type(), "chunk_moments", [&] {
    const scalar_t* all = values.const_data_ptr<scalar_t>();
    scalar_t *to_sums = sums.mutable_data_ptr<scalar_t>(), *to_squares = squares.mutable_data_ptr<scalar_t>();
    for_chunks(shape, [&](const int64_t sample, const int64_t chunk, const int64_t channel, const int64_t count) {
      const int64_t number = shape.end(chunk) - shape.begin(chunk);
      const scalar_t* from = all + (sample * shape.places + shape.begin(chunk)) * shape.channels + channel;
      Vec<scalar_t> sum{}, square{};
      for (int64_t place = 0; place < number; ++place) sum += load(from + place * shape.channels, count);
      const Vec<scalar_t> mean = sum / static_cast<scalar_t>(number);
      for (int64_t place = 0; place < number; ++place) {
        const Vec<scalar_t> distance = load(from + place * shape.channels, count) - mean;
        square += distance * distance;
      }
      const int64_t to = (sample * shape.chunks + chunk) * shape.channels + channel;
      store(to_sums + to, sum, count);
      store(to_squares + to, square, count);
    });
  });
}

// values * factor + offset, rectified if asked for.
void scale_shift(const at::Tensor& values, const at::Tensor& factor, const at::Tensor& offset, const bool rectify,
                 at::Tensor result) {
  check(values, result);
  check_table(factor, values);
  check_table(offset, values);
  const Shape shape(values);
  AT_DISPATCH_FLOATING_TYPES(values.scalar_type(), "scale_shift", [&] {
    const scalar_t* all = values.const_data_ptr<scalar_t>();
    scalar_t* results = result.mutable_data_ptr<scalar_t>();
    for_chunks(shape, [&](const int64_t sample, const int64_t chunk, const int64_t channel, const int64_t count) {
      const auto a = load(row_of<scalar_t>(factor, shape, sample) + channel, count);
      const auto b = load(row_of<scalar_t>(offset, shape, sample) + channel, count);
      for (int64_t place = shape.begin(chunk); place < shape.end(chunk); ++place) {
        const int64_t at = (sample * shape.places + place) * shape.channels + channel;
        const Vec<scalar_t> value = load(all + at, count) * a + b;
        store(results + at, rectify ? lanes::rectified<scalar_t>(value) : value, count);
      }
    });
  });
}

// A gradient where values * factor + offset is above zero, and zero elsewhere: that sum is cheaper than to keep and read what
// came out.
template <typename T>
inline Vec<T> where_positive(const Vec<T>& gradient, const Vec<T>& value, const Vec<T>& factor, const Vec<T>& offset) {
  const Vec<T> zero{}, result = value * factor + offset;
  return result > zero ? gradient : zero;
}

// Sums (B, chunks, C) of the gradient and of its products with values - mean; of the gradient where `scale_shift` gave more
// than zero, if it rectified.
void gradient_sums(const at::Tensor& gradient, const at::Tensor& values, const at::Tensor& factor, const at::Tensor& offset,
                   const bool rectified, const at::Tensor& mean, at::Tensor totals, at::Tensor along) {
  check(gradient, values);
  for (const auto& table : {factor, offset, mean}) check_table(table, values);
  const Shape shape(values);
  AT_DISPATCH_FLOATING_TYPES(values.scalar_type(), "gradient_sums", [&] {
    const scalar_t *all = values.const_data_ptr<scalar_t>(), *upstream = gradient.const_data_ptr<scalar_t>();
    scalar_t *to_totals = totals.mutable_data_ptr<scalar_t>(), *to_along = along.mutable_data_ptr<scalar_t>();
    for_chunks(shape, [&](const int64_t sample, const int64_t chunk, const int64_t channel, const int64_t count) {
      const auto a = load(row_of<scalar_t>(factor, shape, sample) + channel, count);
      const auto b = load(row_of<scalar_t>(offset, shape, sample) + channel, count);
      const auto center = load(row_of<scalar_t>(mean, shape, sample) + channel, count);
      Vec<scalar_t> total{}, product{};
      for (int64_t place = shape.begin(chunk); place < shape.end(chunk); ++place) {
        const int64_t at = (sample * shape.places + place) * shape.channels + channel;
        const auto value = load(all + at, count);
        auto g = load(upstream + at, count);
        if (rectified) g = where_positive<scalar_t>(g, value, a, b);
        total += g;
        product += g * (value - center);
      }
      const int64_t to = (sample * shape.chunks + chunk) * shape.channels + channel;
      store(to_totals + to, total, count);
      store(to_along + to, product, count);
    });
  });
}

// gradient * factor + values * by_value + constant, the gradient counted as in `gradient_sums`. The result may be its memory.
void normalized_gradient(const at::Tensor& gradient, const at::Tensor& values, const at::Tensor& factor,
                         const at::Tensor& offset, const bool rectified, const at::Tensor& by_value, const at::Tensor& constant,
                         at::Tensor result) {
  check(gradient, values);
  check(result, values);
  for (const auto& table : {factor, offset, by_value, constant}) check_table(table, values);
  const Shape shape(values);
  AT_DISPATCH_FLOATING_TYPES(values.scalar_type(), "normalized_gradient", [&] {
    const scalar_t *all = values.const_data_ptr<scalar_t>(), *upstream = gradient.const_data_ptr<scalar_t>();
    scalar_t* to = result.mutable_data_ptr<scalar_t>();
    for_chunks(shape, [&](const int64_t sample, const int64_t chunk, const int64_t channel, const int64_t count) {
      const auto a = load(row_of<scalar_t>(factor, shape, sample) + channel, count);
      const auto b = load(row_of<scalar_t>(offset, shape, sample) + channel, count);
      const auto along = load(row_of<scalar_t>(by_value, shape, sample) + channel, count);
      const auto c = load(row_of<scalar_t>(constant, shape, sample) + channel, count);
      for (int64_t place = shape.begin(chunk); place < shape.end(chunk); ++place) {
        const int64_t at = (sample * shape.places + place) * shape.channels + channel;
        const auto value = load(all + at, count);
        auto g = load(upstream + at, count);
        if (rectified) g = where_positive<scalar_t>(g, value, a, b);
        store(to + at, Vec<scalar_t>(g * a + value * along + c), count);
      }
    });
  });
}

}  // namespace

TORCH_LIBRARY_FRAGMENT(sphericalvision, library) {
  library.def("chunk_moments(Tensor values, Tensor(a!) sums, Tensor(b!) squares) -> ()");
  library.def("scale_shift(Tensor values, Tensor factor, Tensor offset, bool rectify, Tensor(a!) result) -> ()");
  library.def("gradient_sums(Tensor gradient, Tensor values, Tensor factor, Tensor offset, bool rectified, Tensor mean, "
              "Tensor(a!) totals, Tensor(b!) along) -> ()");
  library.def("normalized_gradient(Tensor gradient, Tensor values, Tensor factor, Tensor offset, bool rectified, "
              "Tensor by_value, Tensor constant, Tensor(a!) result) -> ()");
}

TORCH_LIBRARY_IMPL(sphericalvision, CPU, library) {
  library.impl("chunk_moments", &chunk_moments);
  library.impl("scale_shift", &scale_shift);
  library.impl("gradient_sums", &gradient_sums);
  library.impl("normalized_gradient", &normalized_gradient);
}
