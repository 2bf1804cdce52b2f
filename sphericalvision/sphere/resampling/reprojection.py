# SPDX-License-Identifier: Apache-2.0
"""Depth seen from another place than the camera: rays of a target meet the surface that a camera has seen."""

from __future__ import annotations

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sphericalvision.cameras import Camera
from sphericalvision.geometry.directions import normalize
from sphericalvision.geometry.surfaces import distance_along
from sphericalvision.sphere.grids.sphere_grid import SphereGrid
from sphericalvision.sphere.resampling.supersampling import cell_samples, grid_shape


@torch.no_grad()
def distances_from(
    start: Float[Tensor, " 3"],
    target: SphereGrid | Camera,
    target_from_camera: Float[Tensor, "3 3"],
    camera: Camera,
    inverse_depth: Float[Tensor, "*b 1 h w"],
    weight: Float[Tensor, "*b 1 h w"],
    usable: Bool[Tensor, "*#b h w"],
) -> tuple[Float[Tensor, "*distances"], Float[Tensor, "*weights"]]:
    """Return distances ``(*b, 1, *target_shape)`` from a point to the surface of a camera, and weights of its pixels.

    Args:
        start: of the rays, in the camera's frame.
        target: whose directions these are.
        target_from_camera: rotation.
        camera: that has seen the surface.
        inverse_depth: along its rays.
        weight: of its pixels.
        usable: where the inverse depth is valid.
    """
    cells = cell_samples(target, 1, inverse_depth.dtype, inverse_depth.device)
    rays = cells.directions[:, 0] @ target_from_camera.to(inverse_depth)
    valid = usable.to(inverse_depth).expand(inverse_depth.squeeze(-3).shape).unsqueeze(-3)
    # Interpolated together with where it is valid, so that the quotient is a mean over valid pixels alone.
    layers = torch.cat((inverse_depth * valid, valid, weight * valid), -3)
    pairs = [_intersect(camera, frame, start, rays) for frame in layers.reshape(-1, *layers.shape[-3:])]
    shape = (*layers.shape[:-3], 1, *grid_shape(target, "target"))
    distance, weights = (torch.stack(each).reshape(shape) for each in zip(*pairs, strict=True))
    if cells.valid is not None:
        weights = torch.where(cells.valid.view(shape[-2:]), weights, 0.0)
    return distance, weights


def _intersect(camera: Camera, layers: Tensor, start: Tensor, rays: Tensor) -> tuple[Tensor, Tensor]:
    """Distance along rays (n, 3) to the surface of one image, and the weight there, 0 where they meet none.

    The layers (3, h, w) are inverse depth, where it is valid, and weights, each times where it is valid.
    """

    def at(directions: Tensor) -> tuple[Tensor, Tensor]:
        (inverse, coverage, weight), inside = camera.sample(layers, directions)
        valid = inside & (coverage > 0.5)  # most of the four pixels around
        coverage = torch.where(valid, coverage, 1.0)
        return (inverse / coverage).where(valid, math.nan), torch.where(valid, weight / coverage, 0.0)

    largest = float(layers[0].max())
    if not largest > 0:  # the camera has seen nothing
        return torch.zeros_like(rays[:, 0]), torch.zeros_like(rays[:, 0])
    distance = distance_along(rays, start, lambda directions: at(directions)[0], 1 / largest)
    met = distance.isfinite()
    distance = torch.where(met, distance, 1.0)
    # The pixel that has seen the point of intersection is in the direction from the camera to it.
    return distance, torch.where(met, at(normalize(start + distance[:, None] * rays))[1], 0.0)
