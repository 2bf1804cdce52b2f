# SPDX-License-Identifier: Apache-2.0
"""What scenes are made of: affine images of four unit shapes, kept as one table."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any, NamedTuple, TypeVar

import torch
from jaxtyping import Float
from torch import Tensor

from sphericalvision.core import ArgumentError, check_choice

#: Unit shapes, in their local frame: the square [-1, 1]² at z = 0, the cube [-1, 1]³, the unit ball, and the
#: cylinder x² + z² <= 1, |y| <= 1. Every primitive is one of them, stretched by ``half``, turned and moved.
SHAPES = ("rectangle", "box", "ellipsoid", "cylinder")

Vector = tuple[float, float, float]
Table = TypeVar("Table", bound=Any)


@dataclass(frozen=True)
class Part:
    """One primitive while a scene is being put together: plain numbers, metres and radians.

    It is turned by ``yaw`` about the vertical, from +z towards +x; ``rotation`` (rows are the local axes)
    replaces ``yaw`` for what does not stand upright.
    """

    shape: str
    center: Vector
    half: Vector
    material: int = 0
    yaw: float = 0.0
    rotation: Sequence[Sequence[float]] | None = None
    casts_shadow: bool = True
    uv_origin: tuple[float, float] = (0.0, 0.0)
    label: int = 0


class Columns(NamedTuple):
    """A table of primitives stored by coordinate and sorted by shape.

    Attributes:
        order: ``(P,)`` rows of the table.
        place: ``(P,)`` where each row of the table is here.
        starts: where each of :data:`SHAPES` starts, and the end.
        frame: ``(3, 3, P)`` local_from_world.
        offset: ``(3, P)`` centres, local.
        box: ``(3, P)`` half sizes of the unit shapes' boxes: 1, or 0 across a rectangle.
        half: ``(3, P)`` metres.
    """

    order: Tensor
    place: Tensor
    starts: tuple[int, ...]
    frame: Tensor
    offset: Tensor
    box: Tensor
    half: Tensor


def map_columns(function: Callable[..., Any], *tables: Table) -> Table:
    """The table whose columns are what a function makes of those of one table, or of several of the same type."""
    columns = {f.name: function(*(getattr(table, f.name) for table in tables)) for f in fields(tables[0])}
    return type(tables[0])(**columns)


@dataclass(frozen=True)
class Primitives:
    """A table of P primitives.

    Attributes:
        shape: ``(P,)`` index into :data:`SHAPES`.
        center: ``(P, 3)`` metres, world frame.
        rotation: ``(P, 3, 3)`` local_from_world rotations; the rows are the local axes in the world.
        half: ``(P, 3)`` half sizes along the local axes, metres.
        material: ``(P,)`` index into the scene's materials.
        uv_origin: ``(P, 2)`` metres, where the surface coordinates start; lets the parts of a split wall
            share a texture.
        casts_shadow: ``(P,)`` bool.
        label: ``(P,)`` what the surface is, an index into ``SURFACE_LABELS``.
    """

    shape: Tensor
    center: Tensor
    rotation: Tensor
    half: Tensor
    material: Tensor
    uv_origin: Tensor
    casts_shadow: Tensor
    label: Tensor

    def __len__(self) -> int:
        return int(self.shape.shape[0])

    @cached_property
    def columns(self) -> Columns:
        """The table as intersections need it."""
        order = torch.cat([(self.shape == SHAPES.index(name)).nonzero()[:, 0] for name in SHAPES])
        ranks = torch.empty_like(order)
        ranks[order] = torch.arange(len(order), device=order.device)
        frame = (self.rotation / self.half[:, :, None])[order].permute(1, 2, 0).contiguous()
        box = torch.ones_like(self.half)
        box[self.shape == SHAPES.index("rectangle"), 2] = 0
        counts = torch.bincount(self.shape, minlength=len(SHAPES)).tolist()
        return Columns(
            order=order,
            place=ranks,
            starts=tuple(sum(counts[:k]) for k in range(len(SHAPES) + 1)),
            frame=frame,
            offset=(frame * self.center[order].T).sum(1),
            box=box[order].T.contiguous(),
            half=self.half[order].T.contiguous(),
        )

    @cached_property
    def shadow_casters(self) -> Primitives:
        """The rows that cast shadows."""
        rows = self.casts_shadow.nonzero()[:, 0]
        return map_columns(lambda column: column[rows], self)

    @cached_property
    def caster_row(self) -> Tensor:
        """``(P,)`` each row's number among the shadow casters, -1 where it casts none."""
        return torch.where(self.casts_shadow, self.casts_shadow.cumsum(0) - 1, -1)

    def transformed(
        self, rotation: Float[Tensor, "3 3"] | None = None, translation: Float[Tensor, " 3"] | None = None
    ) -> Primitives:
        """The table turned by ``rotation`` ``(3, 3)`` then moved by ``translation`` (metres)."""
        center, local_from_world = self.center, self.rotation
        if rotation is not None:
            center, local_from_world = center @ rotation.T, local_from_world @ rotation.T
        if translation is not None:
            center = center + translation
        return replace(self, center=center, rotation=local_from_world)

    def scaled(self, factor: float) -> Primitives:
        """The table with every length multiplied by ``factor``, about the world's origin."""
        return replace(
            self, center=self.center * factor, half=self.half * factor, uv_origin=self.uv_origin * factor
        )

    def distance_from(self, point: Tensor) -> Tensor:
        """``(P,)`` distances in metres from ``point`` to each primitive's bounding oriented box; 0 inside."""
        local = (self.rotation @ (point - self.center)[:, :, None])[:, :, 0]
        half = self.half.clone()
        half[self.shape == SHAPES.index("rectangle"), 2] = 0
        return (local.abs() - half).clamp(min=0).norm(dim=-1)


def pack(parts: Sequence[Part]) -> Primitives:
    """Make the table of a list of parts (float32, CPU).

    Raises:
        ArgumentError: no parts, an unknown shape, or a size that is not positive.

    Examples:
        >>> len(pack([Part("box", (0.0, 0.5, 2.0), (0.2, 0.5, 0.2))]))
        1
    """
    if not parts:
        raise ArgumentError("parts: expected at least one part, got none")
    for part in parts:
        check_choice("shape", part.shape, SHAPES)
        if min(part.half) <= 0:
            raise ArgumentError(f"half: expected three positive half sizes in metres, got {part.half}")
    upright = torch.tensor([part.yaw for part in parts], dtype=torch.float32)
    sin, cos = upright.sin(), upright.cos()
    zero, one = torch.zeros_like(sin), torch.ones_like(sin)
    rotation = torch.stack([cos, zero, -sin, zero, one, zero, sin, zero, cos], -1).reshape(-1, 3, 3)
    for row, part in enumerate(parts):
        if part.rotation is not None:
            rotation[row] = torch.as_tensor(part.rotation, dtype=torch.float32)
    return Primitives(
        shape=torch.tensor([SHAPES.index(part.shape) for part in parts]),
        center=torch.tensor([part.center for part in parts], dtype=torch.float32),
        rotation=rotation,
        half=torch.tensor([part.half for part in parts], dtype=torch.float32),
        material=torch.tensor([part.material for part in parts]),
        uv_origin=torch.tensor([part.uv_origin for part in parts], dtype=torch.float32),
        casts_shadow=torch.tensor([part.casts_shadow for part in parts]),
        label=torch.tensor([part.label for part in parts]),
    )
