# SPDX-License-Identifier: Apache-2.0
"""Constant folding of traced networks: what does not depend on the inputs is computed once."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import accumulate, repeat
from typing import Any

import torch
from torch import Tensor
from torch.fx import Graph, GraphModule, Interpreter, Node

__all__ = ["with_constants_folded"]

LOOKUPS = {torch.ops.aten.index_select.default: 2, torch.ops.aten.embedding.default: 1}
"""Operation -> which of its arguments says what is looked up; both take 32 bits."""
PARTS = {
    torch.ops.aten.unbind.int: 1,
    torch.ops.aten.split.Tensor: 2,
    torch.ops.aten.split_with_sizes.default: 2,
}
"""Operation that returns several parts of a tensor -> which of its arguments is the dimension."""
CONVOLUTIONS = tuple(getattr(torch.ops.aten, f"conv{dims}d").default for dims in (1, 2, 3))


def with_constants_folded(traced: GraphModule, *inputs: Any) -> GraphModule:
    """Return a traced module in which everything that does not depend on its inputs is a constant.

    Index arithmetic of icospheres makes up most of a network's graph, and none of it depends on images.
    """
    values: dict[Node, Any] = {}

    class Remembering(Interpreter):
        def run_node(self, n: Node) -> Any:
            value = super().run_node(n)
            if n.op == "get_attr" or (
                n.op == "call_function" and all(a in values for a in n.all_input_nodes)
            ):
                values[n] = value
            return value

    Remembering(traced).run(*inputs)
    for number, node in enumerate(list(traced.graph.nodes)):
        if node.op != "call_function":
            continue
        if node.target in CONVOLUTIONS and node.args[2:3] in ((), (None,)):
            # Converters write a bias of zeros in a way that onnxruntime refuses.
            weight = values[node.args[1]]  # type: ignore[index]
            traced.register_buffer(f"bias{number}", weight.new_zeros(len(weight)))
            with traced.graph.inserting_before(node):
                bias = traced.graph.get_attr(f"bias{number}")
            node.args = (*node.args[:2], bias, *node.args[3:])
        if "assert" in str(node.target):
            traced.graph.erase_node(node)
        elif isinstance(values.get(node), Tensor) and any(user not in values for user in node.users):
            name = f"constant{number}"
            constant_value = values[node].detach().clone()
            traced.register_buffer(name, constant_value.int() if _only_places(node) else constant_value)
            with traced.graph.inserting_before(node):
                constant = traced.graph.get_attr(name)
            values[constant] = values[node]
            node.replace_all_uses_with(constant)
    _slice_parts(traced.graph)
    traced.graph.eliminate_dead_code()
    traced.recompile()
    return traced


def _slice_parts(graph: Graph) -> None:
    """Take each part of a split tensor by itself: ONNX has sequences for several, which not every runtime knows."""
    for node in graph.nodes:
        if node.target not in PARTS:
            continue
        tensor, *sizes, dim = node.args if len(node.args) > PARTS[node.target] else (*node.args, 0)
        for user in list(node.users):
            part: Any = user.args[1]
            with graph.inserting_before(user):
                if not sizes:
                    one = graph.call_function(torch.ops.aten.select.int, (tensor, dim, part))
                else:
                    ends = list(
                        accumulate(sizes[0] if isinstance(sizes[0], Sequence) else repeat(sizes[0], part + 1))
                    )
                    bounds = ([0, *ends][part], ends[part])
                    one = graph.call_function(torch.ops.aten.slice.Tensor, (tensor, dim, *bounds))
            user.replace_all_uses_with(one)


def _only_places(node: Node) -> bool:
    """Whether a constant only says what to look up, for which 32 bits do: half the size of large tables."""
    return node.meta["val"].dtype == torch.int64 and all(
        user.target in LOOKUPS
        and [k for k, argument in enumerate(user.args) if argument is node] == [LOOKUPS[user.target]]
        for user in node.users
    )
