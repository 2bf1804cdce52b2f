// SPDX-License-Identifier: Apache-2.0
// From the rectangles of a crown to vertices in one pass, where slices of torch take a copy and a sum for every border.

#include <ATen/Parallel.h>
#include <ATen/core/Tensor.h>
#include <ATen/Dispatch.h>
#include <torch/library.h>

#include <vector>

#include "lanes.h"
#include "volumes.h"

namespace {

using lanes::LANES, lanes::load, lanes::store, lanes::Vec;
using volumes::CHARTS, volumes::Volumes;

// Sum each vertex over its places, `places[starts[v]]` to `places[starts[v + 1] - 1]`, or take their mean. Places are counted
// through five col and five row rectangles; these are (B * 5, N, h, w, C) each, and the result (B, N, 1, V, C).
void sum_over_places(const at::Tensor& col, const at::Tensor& row, const at::Tensor& starts, const at::Tensor& places,
                     const bool mean, at::Tensor result) {
  const int64_t size = col.size(2) * col.size(3), vertices = result.size(3);
  TORCH_CHECK(col.dim() == 5 && row.dim() == 5 && result.dim() == 5 && col.size(0) == CHARTS * result.size(0) &&
                  row.size(0) == col.size(0) && row.size(2) * row.size(3) == size && result.size(2) == 1,
              "rectangles and vertices do not fit: ", col.sizes(), ", ", row.sizes(), " and ", result.sizes());
  for (const int dim : {1, 4}) TORCH_CHECK(col.size(dim) == result.size(dim) && row.size(dim) == result.size(dim), "sizes differ");
  TORCH_CHECK(starts.scalar_type() == at::kInt && places.scalar_type() == at::kInt && starts.is_contiguous() &&
                  places.is_contiguous() && starts.numel() == vertices + 1 && places.numel() == 2 * CHARTS * size,
              "expected tables in int32 of ", vertices, " vertices at ", 2 * CHARTS * size, " places");
  const int32_t *start = starts.const_data_ptr<int32_t>(), *place = places.const_data_ptr<int32_t>();
  AT_DISPATCH_FLOATING_TYPES(col.scalar_type(), "sum_over_places", [&] {
    const Volumes<scalar_t> kinds[2] = {{col, "col"}, {row, "row"}}, to(result, "result");
    // Where the places of all vertices lie in the first sample's first hypothesis: divisions, once for all of them.
    std::vector<const scalar_t*> first(places.numel());
    for (int64_t i = 0; i < places.numel(); ++i) {
      const int64_t rectangle = place[i] / size, at = place[i] % size;
      TORCH_CHECK(place[i] >= 0 && rectangle < 2 * CHARTS, "places: expected numbers below ", 2 * CHARTS * size);
      const Volumes<scalar_t>& kind = kinds[rectangle / CHARTS];
      first[i] = kind.at(rectangle % CHARTS, 0, at / kind.width, at % kind.width, 0);
    }
    at::parallel_for(0, to.batch * to.depth, 1, [&](const int64_t begin, const int64_t end) {
      for (int64_t task = begin; task < end; ++task) {
        const int64_t b = task / to.depth, depth = task % to.depth;
        for (int64_t vertex = 0; vertex < vertices; ++vertex) {
          const scalar_t* from[2 * CHARTS];  // a pole has one in every rectangle, nobody has more
          int number = 0;
          for (int32_t i = start[vertex]; i < start[vertex + 1] && number < 2 * CHARTS; ++i) {
            const Volumes<scalar_t>& kind = kinds[place[i] >= CHARTS * size];
            from[number++] = first[i] + b * CHARTS * kind.next + depth * kind.deep;
          }
          for (int64_t block = 0; block < to.blocks; ++block) {
            const int64_t count = to.in_block(block);
            Vec<scalar_t> sum{};
            for (int i = 0; i < number; ++i) sum += load(from[i] + block * LANES, count);
            if (mean) sum *= static_cast<scalar_t>(1) / static_cast<scalar_t>(number);
            store(to.at(b, depth, 0, vertex, block), sum, count);
          }
        }
      }
    });
  });
}

}  // namespace

TORCH_LIBRARY_FRAGMENT(sphericalvision, library) {
  library.def("sum_over_places(Tensor col, Tensor row, Tensor starts, Tensor places, bool mean, Tensor(a!) result) -> ()");
}

TORCH_LIBRARY_IMPL(sphericalvision, CPU, library) { library.impl("sum_over_places", &sum_over_places); }
