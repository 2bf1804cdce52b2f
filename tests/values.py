# SPDX-License-Identifier: Apache-2.0
"""Values of tests that are the same each time."""

import ast
import math
from collections.abc import Iterator, Mapping
from importlib import import_module
from typing import Any

import numpy as np
import torch
from torch import Tensor

import sphericalvision

ROOMS = "cameras capture crown data geometry icosphere losses metrics models scenes sphere sweep viz"


def names_in(call: str, modules: str = "") -> dict[str, Any]:
    """Public names of all rooms, and those of some modules, that a call uses: what it does not need is not imported."""
    used = {node.id for node in ast.walk(ast.parse(call)) if isinstance(node, ast.Name)}
    rooms = [getattr(sphericalvision, room) for room in ROOMS.split()]
    found = {name: getattr(room, name) for room in rooms for name in used.intersection(room.__all__)}
    loaded = (vars(import_module(f"sphericalvision.{module}")) for module in modules.split())
    return found | {name: names[name] for names in loaded for name in used.intersection(names)}


def random_values(*shape: int, seed: int = 1) -> Tensor:
    return torch.randn(shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


def rand(*shape: int, seed: int = 0) -> Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def weighted_sum(*values: Tensor) -> float:
    """A sum over all numbers, each weighted by where it stands, so that none can change or move unnoticed."""
    numbers = torch.cat([value.detach().double().flatten() for value in values])
    return float(numbers @ torch.arange(1.0, len(numbers) + 1, dtype=torch.float64).cos())


def coarse_sum(*pictures: Tensor) -> float:
    """``weighted_sum`` of means over squares of pictures ``(3, h, w)``: a pixel at an edge changes little."""
    return weighted_sum(*(torch.nn.functional.avg_pool2d(picture, 4) for picture in pictures))


def tensors_of(value: Any) -> Iterator[Tensor]:
    """All numbers within a result, whatever it is made of; -1 where there is none, 10,000 beyond."""
    if isinstance(value, Mapping):
        value = value.values()
    elif hasattr(value, "intrinsic_names"):  # a camera
        value = [getattr(value, name) for name in (*value.intrinsic_names, "max_angle", "image_size")]
    elif hasattr(value, "world_from_camera"):  # a rig or a walk
        value = [value.world_from_camera, getattr(value, "cameras", {})]
    elif isinstance(value, Tensor | np.ndarray | float | int):
        numbers = torch.as_tensor(np.array(value) if isinstance(value, np.ndarray) else value)
        yield numbers.detach().double().nan_to_num(-1.0).clamp(-1e4, 1e4)
        return
    if value is not None and not isinstance(value, str):
        for part in value:
            yield from tensors_of(part)


def numbers_in(table: str) -> list[tuple[str, float]]:
    """Calls of a table, a line each, and the sums of what they return."""
    rows = (line.rpartition(" -> ") for line in table.strip().splitlines())
    return [(call, float(number)) for call, _, number in rows]


def sum_of(call: str, names: Mapping[str, Any], modules: str = "") -> float:
    """``weighted_sum`` over what a call returns, which may use all public names, those of these modules, and these."""
    return weighted_sum(*tensors_of(eval(call, {"math": math, **names_in(call, modules), **names})))
