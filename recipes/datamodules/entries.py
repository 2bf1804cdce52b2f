# SPDX-License-Identifier: Apache-2.0
"""The entries of samples that a network takes from a batch."""

from typing import Any

import torch
from torch import Tensor

from sphericalvision.core import ArgumentError, ShapeError
from sphericalvision.icosphere import level_from_num_vertices, num_icosphere_vertices
from sphericalvision.models import DepthNetwork
from sphericalvision.recipes.datamodules.data_module import Sample
from sphericalvision.scenes.samples import images_as_floats
from sphericalvision.sweep.ring_mean import coarser_images, ids_of_coarser_level


def images_of(batch: Sample, net: DepthNetwork) -> tuple[Tensor, Tensor | None]:
    """The images of a batch that a network takes, and what of them was seen (None where samples do not tell).

    Those on a finer icosphere than it looks at, for a network that it is compared with, are averaged.

    Raises:
        ArgumentError: these samples do not hold them.
    """
    key, seen = ("images", "seen") if net.images == "sphere" else ("fisheye", "fisheye_seen")
    images = _entry(batch, key, net)
    if images.dtype == torch.uint8:
        images = images_as_floats(images, batch[seen])
    visible = batch.get(seen)
    if net.images == "sphere" and visible is not None:
        while images.shape[-1] > num_icosphere_vertices(net.image_level):
            images, visible = coarser_images(images, visible)
    return images, visible


def truth_of(batch: Sample, net: DepthNetwork) -> tuple[Tensor, Tensor]:
    """Inverse depth in 1/m of a batch on the grid of a network, and where it is known, both ``(B, *grid)``.

    Raises:
        ArgumentError: these samples do not hold it, or only on another icosphere.
    """
    grid: Any = net.grid
    if net.depth_level is None:
        whole = [_entry(batch, f"panorama_{name}", net) for name in ("inverse_depth", "valid")]
        try:
            inverse_depth, valid = map(grid.rows_of, whole)
        except ShapeError:
            height, width = whole[0].shape[-2:]
            raise ArgumentError(
                f"data: samples have depth on panoramas of {height} x {width} (height x width), {type(net).__name__} "
                f"estimates it on {grid.height} x {grid.width}; set model.output_size=[{height},{width}], or "
                f"[{height // 2},{width}] for the rows within 45 degrees"
            ) from None
        return inverse_depth, valid
    inverse_depth, valid = _entry(batch, "inverse_depth", net), _entry(batch, "valid", net)
    size, level = inverse_depth.shape[-1], grid.level
    if size < grid.num_vertices:
        raise ArgumentError(
            f"data: samples have depth at {size} vertices, {type(net).__name__} estimates it at "
            f"{grid.num_vertices} (level {level}); take data of that level or a finer one"
        )
    # A finer icosphere has the vertices of a coarser one, where depth is as exact
    if size > grid.num_vertices:
        ids = ids_of_coarser_level(level_from_num_vertices(size), level, inverse_depth.device)
        inverse_depth, valid = inverse_depth[..., ids], valid[..., ids]
    return inverse_depth, valid


def _entry(batch: Sample, key: str, net: DepthNetwork) -> Any:
    if key in batch:
        return batch[key]
    raise ArgumentError(
        f"data: {type(net).__name__} wants the entry '{key}', samples hold {', '.join(batch)}; leave out data.entries, "
        "or take other data"
    )
