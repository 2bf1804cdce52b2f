# SPDX-License-Identifier: Apache-2.0
"""Files that one depth estimate becomes: a picture, a point cloud, and arrays."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from sphericalvision.cameras import CameraRig
from sphericalvision.deploy import Depth
from sphericalvision.io.files import atomic_write
from sphericalvision.io.images import write_image
from sphericalvision.models import DepthNetwork
from sphericalvision.sphere import Equirectangular
from sphericalvision.viz.panorama import rgb_panorama, save_depth_panorama
from sphericalvision.viz.pointcloud import panorama_point_cloud, save_point_cloud

__all__ = ["DepthResult", "estimate_depth", "result_of", "save_result"]


@dataclass(frozen=True)
class DepthResult:
    """What a network says about one frame; ``H`` rows and ``2 * H`` columns of panorama.

    Attributes:
        directions: ``(V, 3)`` of the network's own grid: the vertices of an icosphere, or the pixels of a panorama.
        index: ``(V,)`` hypothesis index there.
        inverse_depth: ``(V,)`` 1/m.
        confidence: ``(V,)`` 0 to 1.
        seen: ``(V,)`` two cameras saw that point; elsewhere the index is a guess from the surroundings.
        panorama: ``(H, 2 * H)`` depth in metres along the rays from the rig's centre; NaN where the network's grid does
            not reach.
        matched: ``(H, 2 * H)`` two cameras saw the point at that depth; elsewhere ``panorama`` is a guess.
        min_depth: nearest hypothesis in metres.
        max_depth: metres; farther is not told from infinity: half a hypothesis away from it.
    """

    directions: Tensor
    index: Tensor
    inverse_depth: Tensor
    confidence: Tensor
    seen: Tensor
    panorama: Tensor
    matched: Tensor
    min_depth: float
    max_depth: float

    @property
    def share_matched(self) -> float:
        """Share of the sphere, by solid angle, where ``matched``."""
        weights = Equirectangular(*self.panorama.shape).solid_angles
        return float((weights * self.matched).sum() / weights.sum())


@torch.inference_mode()
def estimate_depth(
    net: DepthNetwork, images: Tensor, rig: CameraRig, height: int = 320, seen: Tensor | None = None
) -> DepthResult:
    """Estimate the depth of one frame of an unbatched rig, on the network's device.

    The images are those that the network wants: ``(n, 3, V)`` on icospheres, or ``(n, 3, H, W)`` of the cameras;
    ``seen`` ``(n, V)`` or ``(n, H, W)`` tells where they show something.
    """
    device = net.device
    rig = rig.to(device)
    estimate = net.predict(images[None].to(device), rig, None if seen is None else seen[None].to(device))
    index, confidence, both = (values[0] for values in estimate)
    return result_of(Depth(index.float(), confidence.float(), both, net, rig, {}), height)


def result_of(depth: Depth, height: int = 320) -> DepthResult:
    """One frame's depth with a panorama of ``height`` rows, on the CPU."""
    panorama = depth.panorama(height)
    return DepthResult(
        depth.directions.reshape(-1, 3).cpu(),
        depth.index.flatten().cpu(),
        depth.inverse_depth.flatten().cpu(),
        depth.confidence.flatten().cpu(),
        depth.seen.flatten().cpu(),
        panorama.depth.cpu(),
        panorama.seen.cpu(),
        depth.min_depth,
        depth.max_depth,
    )


def save_result(
    folder: Path, prefix: str, result: DepthResult, images: Mapping[str, Tensor], rig: CameraRig
) -> list[Path]:
    """Write pictures of depth and colour, point cloud and arrays, their names after ``prefix``; returns the paths."""
    folder.mkdir(parents=True, exist_ok=True)
    measured = result.panorama.where(result.matched, math.nan)
    picture = save_depth_panorama(folder / f"{prefix}depth.png", measured, result.min_depth)
    colors, seen = rgb_panorama(rig, images, result.panorama.shape[0], result.panorama)
    write_image(folder / f"{prefix}color.png", colors)
    depth = measured.where(seen, math.nan)
    cloud = panorama_point_cloud(depth, colors, max_depth=result.max_depth, center=rig.center)
    written = [picture, folder / f"{prefix}color.png"]
    if len(cloud.points):
        written.append(save_point_cloud(folder / f"{prefix}points.ply", cloud.points, cloud.colors))
    arrays = {
        "index": result.index,
        "inverse_depth": result.inverse_depth,
        "depth": result.inverse_depth.reciprocal(),
        "confidence": result.confidence,
        "seen": result.seen,
        "directions": result.directions,
        "depth_panorama": result.panorama,
        "matched_panorama": result.matched,
        "color_panorama": colors,
        "seen_panorama": seen,
        "center": rig.center,
    }
    path = folder / f"{prefix}depth.npz"
    stored: dict[str, Any] = {key: value.cpu().numpy() for key, value in arrays.items()}
    with atomic_write(path) as temporary:
        np.savez_compressed(temporary, **stored)
    return [*written, path]
