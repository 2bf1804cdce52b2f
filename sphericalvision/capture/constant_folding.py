# SPDX-License-Identifier: Apache-2.0
"""Constant folding of traced networks: what does not depend on the inputs is computed once."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.fx import GraphModule, Interpreter, Node

from sphericalvision.models.weights.files import STEP, with_bits

aten = torch.ops.aten
LOOKUPS = {aten.index_select.default: 2, aten.embedding.default: 1}
"""Operation -> which of its arguments says what is looked up; both take 32 bits."""
CONVOLUTIONS = tuple(getattr(aten, f"conv{dims}d").default for dims in (1, 2, 3))
CHEAP = {aten.view, aten._unsafe_view, aten.reshape, aten.expand, aten.unsqueeze, aten.permute, aten.clone}
CHEAP |= {aten.select, aten.slice, aten.transpose, aten.to, aten._to_copy, aten.add}
"""Operations that cost less than another table in the file: several such views share the table they are of."""
LARGE = 100_000
"""Bytes from which a table is worth an operation more."""


def with_constants_folded(traced: GraphModule, *inputs: Any) -> GraphModule:
    """Return a traced module in which everything that does not depend on its inputs is a constant.

    Index arithmetic of icospheres makes up most of a network's graph, and none of it depends on images. Large tables
    are stored once, however many views of them are used, without their rows of zeros if they have many, integers in
    32 bits if these are enough, and weights that were read from eight bits in 16, times their steps.
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
    views = _views_of_shared_tables(values)
    constants = {node: value for node, value in values.items() if node not in views}
    for number, node in enumerate(list(traced.graph.nodes)):
        if node.target in CONVOLUTIONS and node.args[1] in values:
            weight, name = values[node.args[1]].detach(), f"weight{number}"
            stored = dict(with_bits(name, weight, 8))
            with traced.graph.inserting_before(node):
                if name + STEP in stored and torch.equal(stored[name] * stored[name + STEP], weight):
                    # As halves: TensorRT keeps eight bits for what is computed in them.
                    codes = _buffer(traced, stored[name].half(), name)
                    codes = traced.graph.call_function(aten.to.dtype, (codes, weight.dtype))
                    steps = _buffer(traced, stored[name + STEP], f"{name}_steps")
                    weights = traced.graph.call_function(aten.mul.Tensor, (codes, steps))
                    node.args = (node.args[0], weights, *node.args[2:])
                if node.args[2:3] in ((), (None,)):
                    # Converters write a bias of zeros in a way that onnxruntime refuses.
                    bias = _buffer(traced, weight.new_zeros(len(weight)), f"bias{number}")
                    node.args = (*node.args[:2], bias, *node.args[3:])
        if "assert" in str(node.target):
            traced.graph.erase_node(node)
        elif _is_stored(node, constants) and (
            node.op == "call_function"
            or _is_large_int64(values[node])
            or _only_looked_up(node, values[node])
            or _zero_rows(values[node])[1]
        ):
            values[_store(traced, node, values[node].detach().clone(), f"constant{number}")] = values[node]
    traced.graph.eliminate_dead_code()
    used = {node.target for node in traced.graph.nodes if node.op == "get_attr"}
    for name, _ in [*traced.named_parameters(), *traced.named_buffers()]:
        if name not in used:
            module, _, attribute = name.rpartition(".")
            delattr(traced.get_submodule(module), attribute)
    traced.recompile()
    return traced


def _is_stored(node: Node, values: dict[Node, Any]) -> bool:
    """Whether a constant is an operand of something that depends on the inputs."""
    return isinstance(values.get(node), Tensor) and any(user not in values for user in node.users)


def _is_large_int64(value: Tensor) -> bool:
    return value.dtype == torch.int64 and value.nbytes >= LARGE and int(value.abs().max()) < 2**31


def _store(traced: GraphModule, node: Node, value: Tensor, name: str) -> Node:
    """Replace a node by a buffer, and return what reads it; ids of lookups and large integers go into 32 bits."""
    lookup = _only_looked_up(node, value)
    widened = not lookup and _is_large_int64(value)
    rows, ids = _distinct_rows(value) if widened else (value, None)
    with traced.graph.inserting_before(node.next):
        result = _buffer(traced, rows.int() if lookup or widened else rows, name)
        if ids is not None:
            rows_and_ids = (result, 0, _buffer(traced, ids.int(), f"{name}_ids"))
            result = traced.graph.call_function(aten.index_select.default, rows_and_ids)
        if widened:
            result = traced.graph.call_function(aten.to.dtype, (result, torch.int64))
        if ids is not None:
            result = traced.graph.call_function(aten.view.default, (result, value.shape))
    node.replace_all_uses_with(result)
    return result


def _buffer(traced: GraphModule, value: Tensor, name: str) -> Node:
    """Return what reads a new buffer, or a large one of the same values; many rows of zeros are not stored."""
    call = traced.graph.call_function
    zero_rows, _ = _zero_rows(value)
    if zero_rows is not None:
        rows = value.view(len(zero_rows), -1)
        present = call(aten.to.dtype, (_buffer(traced, ~zero_rows, f"{name}_present"), torch.int32))
        counts = call(aten.cumsum.default, (present, 0), {"dtype": torch.int32})
        numbers = call(aten.mul.Tensor, (counts, present))
        rows = torch.cat((rows.new_zeros(1, rows.shape[1]), rows[~zero_rows]))
        selected = call(aten.index_select.default, (_buffer(traced, rows, name), 0, numbers))
        return call(aten.view.default, (selected, value.shape))
    for other, table in traced.named_buffers() if value.nbytes >= LARGE else ():
        if table.dtype == value.dtype and torch.equal(table.flatten(), value.flatten()):
            return call(aten.reshape.default, (traced.graph.get_attr(other), value.shape))
    traced.register_buffer(name, value)
    return traced.graph.get_attr(name)


def _zero_rows(value: Any) -> tuple[Tensor | None, int]:
    """Return which rows of a table are zero, as a sweep's are out of view, and bytes saved, if many; else None, 0."""
    if not isinstance(value, Tensor) or not value.is_contiguous() or value.nbytes < LARGE:
        return None, 0
    rows = value.view(-1, value.shape[-1] if value.ndim > 1 else 1)
    zero_rows = ~rows.any(1)
    saved = int(zero_rows.sum()) * rows[0].nbytes - len(rows)
    return (zero_rows, saved) if saved >= LARGE else (None, 0)


def _distinct_rows(value: Tensor) -> tuple[Tensor, Tensor | None]:
    """Return the different rows of a table and their ids, if these are less than half; else the table and None.

    A sweep reads the few triangles of an icosphere at many points.
    """
    if value.ndim > 1:
        rows, ids = value.flatten(0, -2).unique(dim=0, return_inverse=True)
        if 2 * (rows.numel() + len(ids)) < value.numel():
            return rows, ids
    return value, None


def _views_of_shared_tables(values: dict[Node, Any]) -> set[Node]:
    """Return the constants that stay computations, as what they are computed from is smaller than all of them.

    A sweep reads its table of vertices as a whole, and each corner of the triangles by itself: stored one by one these
    are twice the table. The largest saving is taken first; the rest is counted again.
    """
    computed: set[Node] = set()
    while True:
        constants = {node: value for node, value in values.items() if node not in computed}
        cheap = {node for node in constants if getattr(node.target, "overloadpacket", None) in CHEAP}
        savings = {}
        for table, value in constants.items():
            if isinstance(value, Tensor) and value.nbytes >= LARGE:
                views = _reached({table}, "users", cheap) - {table}
                stored = {view for view in views if _is_stored(view, constants)}
                saving = sum(constants[view].nbytes for view in stored)
                saving -= 0 if _is_stored(table, constants) else value.nbytes - _zero_rows(value)[1]
                if saving >= LARGE and (len(stored) > 1 or _is_stored(table, constants)):
                    savings[table] = saving, _reached(stored, "all_input_nodes", views)
        if not savings:
            return computed
        computed |= max(savings.values(), key=lambda entry: entry[0])[1]


def _reached(start: set[Node], direction: str, allowed: set[Node]) -> set[Node]:
    """Return some nodes and all that follow from them, by ``users`` or ``all_input_nodes``, among those allowed."""
    reached = set(start)
    todo = list(start)
    while todo:
        fresh = allowed.intersection(getattr(todo.pop(), direction)) - reached
        reached |= fresh
        todo.extend(fresh)
    return reached


def _only_looked_up(node: Node, value: Tensor) -> bool:
    """Whether a constant is the index of lookups alone, for which 32 bits do: half the size of large tables."""
    return value.dtype == torch.int64 and all(
        user.target in LOOKUPS
        and [k for k, argument in enumerate(user.args) if argument is node] == [LOOKUPS[user.target]]
        for user in node.users
    )
