# SPDX-License-Identifier: Apache-2.0
"""Appearance at given depths: the mean colour of the cameras and its deviation, at vertices and around them."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sphericalvision.geometry.lookup import weighted_rows
from sphericalvision.icosphere import icosphere_vertices, level_from_num_vertices
from sphericalvision.icosphere.locator import chunk_size, corners_by_coarser_tables, triangle_corners
from sphericalvision.kernels import Operator
from sphericalvision.shapes import check_shapes
from sphericalvision.sweep.ring_mean import ids_of_coarser_level, vertex_rings
from sphericalvision.sweep.visibility import check_seen
from sphericalvision.tables import constant_table

Source = tuple[Tensor, Tensor, Callable[[Tensor], tuple[Tensor, Tensor]]]
"""Images, seen, and what finds ids and weights ``(m, k)`` of the vertices around rays ``(3, m)``."""
Read = Callable[[Tensor, Tensor], Tensor]
"""From ids and weights ``(m, k)`` to weighted sums ``(C + 1, m)``."""


class AppearanceAtDepth(NamedTuple):
    """Colours of the cameras that see a point, in the unit of the images.

    Attributes:
        color: ``(B, K, C, V)`` their mean.
        deviation: ``(B, K, V)`` their mean absolute deviation from it, over cameras and colours.
        cameras: ``(B, K, V)`` how many there are; where none sees the point the others are 0.
    """

    color: Float[Tensor, "B K C V"]
    deviation: Float[Tensor, "B K V"]
    cameras: Float[Tensor, "B K V"]


@check_shapes
@torch.no_grad()
def appearance_at_depth(
    images: Float[Tensor, "B n C V_image"],
    seen: Bool[Tensor, "B n V_image"] | Bool[Tensor, "n V_image"],
    offsets: Float[Tensor, "B n 3"],
    inverse_depths: Float[Tensor, "B K V"],
) -> AppearanceAtDepth:
    """Return the appearance at K inverse depths at each vertex of an icosphere, without gradient.

    Args:
        images: ``(B, n, C, V_image)`` on icospheres aligned with the world.
        seen: ``([B,] n, V_image)``, True where the images show something.
        offsets: ``(B, n, 3)`` from each camera to the rig's centre, metres in the world.
        inverse_depths: ``(B, K, V)`` in 1/m; 0 is infinity.

    Examples:
        >>> images, seen = torch.ones(1, 2, 3, 162), torch.ones(2, 162, dtype=torch.bool)
        >>> offsets = torch.tensor([[[0.1, 0.0, 0.0], [-0.1, 0.0, 0.0]]])
        >>> color, deviation, cameras = appearance_at_depth(images, seen, offsets, torch.ones(1, 4, 642))
        >>> color.shape, deviation.max().item() < 1e-6, cameras.unique().tolist()
        (torch.Size([1, 4, 3, 642]), True, [2.0])
    """
    vertices = icosphere_vertices(
        level_from_num_vertices(inverse_depths.shape[-1]), offsets.dtype, images.device
    ).T.contiguous()
    corners = partial(triangle_corners, level=level_from_num_vertices(images.shape[-1]))
    source = images, check_seen(seen, images), corners
    return AppearanceAtDepth(*_appearance(source, vertices, offsets, inverse_depths))


@check_shapes
@torch.no_grad()
def appearance_around(
    images: Float[Tensor, "B n C V_image"],
    seen: Bool[Tensor, "B n V_image"] | Bool[Tensor, "n V_image"],
    offsets: Float[Tensor, "B n 3"],
    inverse_depths: Float[Tensor, "B K V"],
    chosen: Bool[Tensor, "B V"],
) -> Float[Tensor, "B K D V"]:
    """Return the appearance around vertices of an icosphere: there and half-way to the neighbours, without gradient.

    At a boundary images of the vertices' own level mix both sides; those of the next finer level have two to four
    pixels there. The D = 4 + C numbers are, in the unit of the images: the deviation, as of ``appearance_at_depth``, at
    the vertex, its mean and its maximum over the seven directions; the mean absolute deviation of their colours; and
    the colour at the vertex.

    Args:
        images: as for ``appearance_at_depth``, best one level finer than the vertices; so are ``seen`` and
            ``offsets``.
        inverse_depths: ``(B, K, V)`` in 1/m, for all seven directions of a vertex.
        chosen: ``(B, V)``; the result is 0 elsewhere, where a CPU computes nothing.

    Examples:
        >>> images, seen = torch.ones(1, 2, 3, 642), torch.ones(2, 642, dtype=torch.bool)
        >>> offsets = torch.tensor([[[0.1, 0.0, 0.0], [-0.1, 0.0, 0.0]]])
        >>> chosen = torch.arange(162)[None] < 100
        >>> around = appearance_around(images, seen, offsets, torch.ones(1, 2, 162), chosen)
        >>> around.shape, around[0, :, 4:, 99].unique(), around[..., 100:].any()
        (torch.Size([1, 2, 7, 162]), tensor([1.]), tensor(False))
    """
    level = level_from_num_vertices(inverse_depths.shape[-1])
    directions = _seven_directions(level, images.device).to(offsets.dtype)
    corners = partial(corners_by_coarser_tables, level=level_from_num_vertices(images.shape[-1]))
    source = images, check_seen(seen, images), corners
    return _around(source, directions, offsets, inverse_depths, chosen)


def _planes(images: Tensor, seen: Tensor) -> Tensor:
    """``(*b, C + 1, V)`` of images ``(*b, C, V)``: colours, and whether they were seen."""
    weight = seen.to(images).unsqueeze(-2)
    return torch.cat((images * weight, weight), -2)


@constant_table
def _seven_directions(level: int, device: torch.device) -> Tensor:
    """Directions ``(3, V, 7)`` of each vertex and half-way to its neighbours; of five it counts itself again."""
    rings = vertex_rings(level + 1, device)[ids_of_coarser_level(level + 1, level, device)]
    return icosphere_vertices(level + 1, device=device)[rings].permute(2, 0, 1).contiguous()


def _around_all(
    source: Source, directions: Tensor, offsets: Tensor, inverse_depths: Tensor, chosen: Tensor
) -> Tensor:
    """Numbers ``(B, K, D, V)``, computed everywhere."""
    inverse_depths = inverse_depths[..., None].expand(*inverse_depths.shape, directions.shape[-1]).flatten(2)
    color, deviation, _ = _appearance(source, directions.flatten(1), offsets, inverse_depths)
    deviation = deviation.unflatten(-1, directions.shape[1:])
    color = color.unflatten(-1, directions.shape[1:])
    variation = (color - color.mean(-1, keepdim=True)).abs().mean((2, -1))
    numbers = torch.stack((deviation[..., 0], deviation.mean(-1), deviation.amax(-1), variation), 2)
    return torch.cat((numbers, color[..., 0]), 2) * chosen[:, None, None]


def _around_chosen(
    source: Source, directions: Tensor, offsets: Tensor, inverse_depths: Tensor, chosen: Tensor
) -> Tensor:
    """The same, computed at the chosen vertices of one sample after the other."""
    images, seen, corners = source
    batch, depths, vertices = inverse_depths.shape
    result = images.new_zeros(batch, depths, 4 + images.shape[2], vertices)
    for sample, ids in enumerate(chosen[number].nonzero().squeeze(1) for number in range(batch)):
        one = slice(sample, sample + 1)
        result[sample][..., ids] = _around_all(
            (images[one], seen[one], corners),
            directions[:, ids],
            offsets[one],
            inverse_depths[one][..., ids],
            chosen[one][:, ids],
        )[0]
    return result


_around = Operator(_around_all, cpu=_around_chosen)


def _by_sample(
    source: Source, vertices: Tensor, offsets: Tensor, inverse_depths: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Sample by sample and some vertices at once, so few that they stay in the cache of a CPU."""
    images, seen, corners = source
    if not len(images):
        return NotImplemented
    size = max(1, chunk_size(images.device) // inverse_depths.shape[1])
    is_few = 4 * inverse_depths[0].numel() < images.shape[-1]
    samples = []
    for image, shown, offset, inverse_depth in zip(images, seen, offsets, inverse_depths, strict=True):
        read = list(map(_read_few if is_few else _read_rows, image, shown))
        chunks = [
            _seen_by_all(read, corners, *chunk, offset)
            for chunk in zip(vertices.split(size, 1), inverse_depth.split(size, 1), strict=True)
        ]
        samples.append([torch.cat(values, -1) for values in zip(*chunks, strict=True)])
    color, deviation, cameras = (torch.stack(values) for values in zip(*samples, strict=True))
    return color, deviation, cameras


def _read_rows(image: Tensor, seen: Tensor) -> Read:
    """Read weighted sums ``(C + 1, m)`` of an image's planes, at ids and weights ``(m, k)``."""
    rows = _planes(image, seen).t().contiguous()  # what is looked up lies next to each other
    return lambda ids, weights: weighted_rows(rows, ids, weights).T.contiguous()


def _read_few(image: Tensor, seen: Tensor) -> Read:
    """The same where few are read, and the rest of the image is not touched."""

    def read(ids: Tensor, weights: Tensor) -> Tensor:
        weights = weights * seen[ids]
        terms = [image.index_select(1, ids[:, k]) * weights[:, k] for k in range(ids.shape[1])]
        return torch.cat((torch.stack(terms).sum(0), weights.sum(1)[None]))

    return read


def _seen_by_all(
    read: list[Read], find: Callable[..., Any], vertices: Tensor, inverse_depth: Tensor, offsets: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Color ``(K, C, V)``, deviation and cameras ``(K, V)`` of some vertices, so few that they stay in the cache."""
    weights, colors = [], []
    for read_camera, offset in zip(read, offsets, strict=True):
        values = read_camera(*find((vertices[:, None] + offset[:, None, None] * inverse_depth).flatten(1)))
        color, shown = values.view(len(values), *inverse_depth.shape).split((len(values) - 1, 1))
        weights.append((shown > 0.5).to(shown))
        colors.append(color / shown.clamp(min=0.5))
    cameras = torch.stack(weights).sum(0)
    mean, far = torch.zeros_like(colors[0]), torch.zeros_like(colors[0])
    for weight, color in zip(weights, colors, strict=True):
        mean += weight * color / cameras.clamp(min=1)
    for weight, color in zip(weights, colors, strict=True):
        far += weight * (color - mean).abs() / cameras.clamp(min=1)
    return mean.transpose(0, 1), far.mean(0), cameras[0]


def _all_at_once(
    source: Source, vertices: Tensor, offsets: Tensor, inverse_depths: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Colours ``(B, K, C, V)``, deviation and cameras ``(B, K, V)`` of ``(B, n, C, V_image)`` without a loop."""
    images, seen, corners = source
    planes = _planes(images, seen)
    batch, cameras, channels, number = planes.shape
    offset = offsets.permute(2, 0, 1)[..., None, None]
    rays = vertices[:, None, None, None] + offset * inverse_depths[:, None]  # (3, B, n, K, V)
    ids, shares = corners(rays.flatten(1))
    first_row = torch.arange(0, batch * cameras * number, number, device=planes.device)
    bags = ids.view(*rays.shape[1:], ids.shape[1]) + first_row.view(batch, cameras, 1, 1, 1)
    values = weighted_rows(planes.mT.reshape(-1, channels), bags.view(ids.shape), shares)
    values = values.view(*rays.shape[1:], channels)
    weights = (values[..., -1:] > 0.5).to(values)
    colors = values[..., :-1] / values[..., -1:].clamp(min=0.5)
    count = weights.sum(1)
    mean = (weights * colors).sum(1) / count.clamp(min=1)
    far = (weights * (colors - mean[:, None]).abs()).sum(1) / count.clamp(min=1)
    return mean.mT, far.mean(-1), count.squeeze(-1)


_appearance = Operator(_all_at_once, cpu=_by_sample, fused=_all_at_once)
