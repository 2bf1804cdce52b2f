# SPDX-License-Identifier: Apache-2.0
"""Rotation of images, depth, normals and labels on a grid: by any rotation, or exactly by a turn of the grid.

Convention:
    Rotations turn the content: what stood in direction d then stands in ``rotation @ d``. A positive yaw turns forward
    (+z) towards right (+x); in an equirectangular image that moves columns to the right.
"""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int, Shaped
from torch import Tensor

from sphericalvision.core import ArgumentError, ShapeError, check_choice
from sphericalvision.geometry import transform_from_quaternion
from sphericalvision.icosphere import Icosphere
from sphericalvision.shapes import check_shapes
from sphericalvision.sphere import Cubemap, Equirectangular, Healpix, SphereGrid

CONTENTS = ("image", "depth", "normals", "labels", "seen")

#: Of the weights of an interpolated value, the sum that must be of cells that were seen.
SEEN_WEIGHT = 0.999


@check_shapes
def rotate_on_sphere(
    values: Shaped[Tensor, "*values"],
    grid: SphereGrid,
    rotation: Float[Tensor, "*turns 3 3"],
    kind: str = "image",
) -> Shaped[Tensor, "*values"]:
    """Rotate values on a grid.

    Args:
        values: ``(*, *grid.shape)``, with the three components in the dimension before the grid's for normals.
        grid: where the values are given, before and after.
        rotation: ``(3, 3)``, or ``(B, 3, 3)`` for values whose first dimension is B.
        kind: ``"image"`` is interpolated; ``"labels"``, of any dtype, and ``"depth"``, along the ray and therefore
            as long as before, are taken from the nearest place, so that no label and no depth is invented;
            ``"normals"`` are interpolated, turned, and of unit length again (zero stays zero); ``"seen"``, bool, is
            True where every place that an image would be interpolated from was seen.

    Returns:
        As the values; differentiable in values and rotation for images and normals.

    Examples:
        >>> grid = Equirectangular(8, 16)
        >>> height = -grid.directions[..., 1]
        >>> upside_down = torch.diag(torch.tensor([1.0, -1.0, -1.0]))
        >>> torch.allclose(rotate_on_sphere(height, grid, upside_down), -height, atol=1e-5)
        True
    """
    flat = _flat(values, grid, rotation.shape[:-2], kind)
    sources = source_directions(grid, rotation)
    if kind in ("depth", "labels"):
        return _gather(flat, grid.nearest(sources)).view(values.shape)
    flat = flat.to(sources) if kind == "seen" else flat
    sampled = grid.sample(flat.unflatten(-1, grid.shape), sources)
    if kind == "seen":
        sampled = sampled > SEEN_WEIGHT
    elif kind == "normals":
        sampled = F.normalize(_rotate_vectors(sampled, rotation), dim=-2)
    return sampled.reshape(values.shape)


def source_directions(grid: SphereGrid, rotation: Float[Tensor, "*turns 3 3"]) -> Float[Tensor, "*turns n 3"]:
    """Return the directions whose content is in each cell of a grid after a rotation.

    What is drawn or rendered there needs no interpolation.

    Args:
        grid: of n cells.
        rotation: ``(*, 3, 3)``, of the content.

    Examples:
        >>> quarter = yaw_rotation(torch.tensor(torch.pi / 2))  # forward towards right
        >>> directions = source_directions(Equirectangular(1, 4), quarter)
        >>> torch.allclose(directions, Equirectangular(1, 4).directions.view(4, 3).roll(1, 0), atol=1e-6)
        True
    """
    directions = grid.directions.reshape(-1, 3)
    return directions @ rotation.to(directions)  # the inverse rotation, on rows


def yaw_on_sphere(
    values: Shaped[Tensor, "*values"],
    grid: SphereGrid,
    steps: Int[Tensor, "*turns"] | int,
    kind: str = "image",
) -> Shaped[Tensor, "*values"]:
    """Rotate values on a grid about the vertical by steps that map the grid onto itself: nothing is interpolated.

    Args:
        values: ``(*, *grid.shape)``, with the three components in the dimension before the grid's for normals.
        grid: ``Equirectangular`` (a step is a column), ``Icosphere`` (72°), ``Cubemap`` or ``Healpix`` (90°).
        steps: any whole number, or ``(B,)`` of them for values whose first dimension is B.
        kind: ``"image"``, ``"depth"``, ``"normals"`` (which are turned, too), ``"labels"``, of any dtype, or
            ``"seen"``.

    Examples:
        >>> yaw_on_sphere(torch.arange(8).view(1, 8), Equirectangular(1, 8), 3, "labels")
        tensor([[5, 6, 7, 0, 1, 2, 3, 4]])
    """
    steps = torch.as_tensor(steps, device=values.device)
    flat = _flat(values, grid, steps.shape, kind)
    moved = _gather(flat, _yaw_ids(grid, steps))
    if kind == "normals":
        moved = _rotate_vectors(moved, yaw_rotation(yaw_angle(steps, num_yaw_steps(grid))))
    return moved.view(values.shape)


def num_yaw_steps(grid: SphereGrid) -> int:
    """Return how many turns about the vertical map a grid onto itself.

    Examples:
        >>> num_yaw_steps(Icosphere(3)), num_yaw_steps(Equirectangular(32, 64))
        (5, 64)
    """
    if isinstance(grid, Equirectangular):
        return grid.width
    if isinstance(grid, (Icosphere, Cubemap, Healpix)):
        return 5 if isinstance(grid, Icosphere) else 4
    raise ArgumentError(
        "grid: expected Equirectangular, Icosphere, Cubemap or Healpix, whose exact turns about the vertical are "
        f"known, got {type(grid).__name__}; turn it by any angle with rotate_on_sphere"
    )


def yaw_rotation(angle: Float[Tensor, "*turns"]) -> Float[Tensor, "*turns 3 3"]:
    """Return the rotations ``(*, 3, 3)`` about the vertical by angles ``(*)`` in radians, forward towards right.

    Examples:
        >>> yaw_rotation(torch.tensor(torch.pi / 2)).round() @ torch.tensor([0.0, 0.0, 1.0])
        tensor([1., 0., 0.])
    """
    sine, cosine = angle.sin(), angle.cos()
    zero, one = torch.zeros_like(sine), torch.ones_like(sine)
    rows = ((cosine, zero, sine), (zero, one, zero), (-sine, zero, cosine))
    return torch.stack([torch.stack(row, -1) for row in rows], -2)


def yaw_angle(steps: Tensor, num_steps: int) -> Tensor:
    """Return the angles in radians, float64, of whole steps of which a turn has ``num_steps``."""
    return steps.double() * (2 * math.pi / num_steps)


def random_rotations(
    count: int, max_angle: float = math.pi, generator: torch.Generator | None = None
) -> Float[Tensor, "count 3 3"]:
    """Draw rotations ``(count, 3, 3)`` evenly from all whose angle is at most ``max_angle``.

    Args:
        count: number of rotations.
        max_angle: radians, above 0 to π; π draws from all of SO(3).
        generator: source of randomness; torch's global one when not given.

    References:
        Miles (1965), "On random rotations in R³": the density of the angle is proportional to 1 - cos.

    Examples:
        >>> turns = random_rotations(4)
        >>> torch.allclose(turns @ turns.mT, torch.eye(3), atol=1e-6)
        True
    """
    if isinstance(count, bool) or not isinstance(count, int) or count < 0:
        raise ArgumentError(f"count: expected a whole number of 0 or more, got {count!r}")
    if not 0 < max_angle <= math.pi:
        raise ArgumentError(f"max_angle: expected more than 0, up to π radians, got {max_angle!r}")
    axis = F.normalize(torch.randn(count, 3, generator=generator, dtype=torch.float64), dim=-1)
    fraction = torch.rand(count, generator=generator, dtype=torch.float64)
    target = fraction * (max_angle - math.sin(max_angle))
    low, high = torch.zeros_like(fraction), torch.full_like(fraction, max_angle)
    for _ in range(60):  # the angle whose distribution function is the share, by bisection
        angle = (low + high) / 2
        below = angle - angle.sin() < target
        low, high = torch.where(below, angle, low), torch.where(below, high, angle)
    half = high[:, None] / 2
    quaternion = torch.cat((half.cos(), half.sin() * axis), -1)
    rotations = transform_from_quaternion(quaternion, torch.zeros_like(axis))[:, :3, :3]
    return rotations.to(torch.get_default_dtype())


def _flat(values: Tensor, grid: SphereGrid, batch: torch.Size, kind: str) -> Tensor:
    """Return values as ``(c, n)``, or ``(B, c, n)`` for a batch of rotations, once everything fits together."""
    check_choice("kind", kind, CONTENTS)
    last = (*((3,) if kind == "normals" else ()), *grid.shape)
    start = values.ndim - len(last)
    if (
        len(batch) > min(start, 1)
        or values.shape[: len(batch)] != batch
        or tuple(values.shape[start:]) != last
    ):
        expected = ", ".join(map(str, (*batch, "*", *last)))
        raise ShapeError(f"values: expected {kind} of shape ({expected}), got {tuple(values.shape)}")
    return values.reshape(*batch, -1, math.prod(grid.shape))


def _gather(flat: Tensor, ids: Tensor) -> Tensor:
    """Return values ``(c, n)`` at ids ``(n,)``, or ``(B, c, n)`` at ``(B, n)``."""
    return flat.gather(-1, ids.unsqueeze(-2).expand_as(flat))  # of bytes in an eighth of index_select's time


def _rotate_vectors(flat: Tensor, rotation: Tensor) -> Tensor:
    """Return vectors, three of the ``c`` rows of ``(c, n)`` or ``(B, c, n)`` each, turned: ``(.., c / 3, 3, n)``."""
    vectors = flat.unflatten(-2, (-1, 3))
    rotation = rotation.to(vectors)
    return (rotation if rotation.ndim == 2 else rotation[:, None]) @ vectors


def _yaw_ids(grid: SphereGrid, steps: Tensor) -> Tensor:
    """Return where in the flattened grid the value of each place comes from, ``(n,)`` or ``(B, n)``."""
    count, steps = num_yaw_steps(grid), steps[..., None]
    index = torch.arange(math.prod(grid.shape), device=steps.device)
    if isinstance(grid, Equirectangular):
        return index - index % count + (index - steps) % count
    if isinstance(grid, Icosphere):  # chart by chart; the poles stay
        last = grid.num_vertices - 1
        moved = 1 + (index - 1 - steps * ((last - 1) // 5)) % (last - 1)
        return torch.where((index == 0) | (index == last), index, moved)
    return grid.nearest(source_directions(grid, yaw_rotation(yaw_angle(steps.squeeze(-1), count))))
