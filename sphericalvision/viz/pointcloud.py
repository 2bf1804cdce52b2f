# SPDX-License-Identifier: Apache-2.0
"""Coloured points: files of them, and the colours that the images of cameras give them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from jaxtyping import Bool, Float, Shaped
from torch import Tensor

from sphericalvision.cameras import CameraRig
from sphericalvision.cameras.rig import check_images_of
from sphericalvision.core import ArgumentError, check_choice
from sphericalvision.io.files import atomic_write, write_bytes
from sphericalvision.kernels import full_precision
from sphericalvision.shapes import check_shapes

SUFFIXES = (".ply", ".glb", ".obj", ".stl", ".xyz")
"""Files of points that can be written."""


@check_shapes
def save_point_cloud(
    path: str | Path,
    points: Float[Tensor, "n 3"],
    colors: Shaped[Tensor, "n 3"],
    normals: Float[Tensor, "n 3"] | None = None,
) -> Path:
    """Write a coloured point cloud (binary .ply, or another format of trimesh) and return its path.

    Args:
        path: the suffix chooses the format.
        points: ``(n, 3)`` metres; a .ply file holds float64 as double.
        colors: ``(n, 3)`` in [0, 1], or uint8.
        normals: ``(n, 3)`` unit vectors, which .ply files hold; other formats go without.

    Raises:
        ArgumentError: no points, or some are not finite; viewers refuse such files.

    Examples:
        >>> save_point_cloud("points.ply", torch.rand(10, 3), torch.ones(10, 3)).name
        'points.ply'
    """
    path = Path(path)
    check_choice("path", path.suffix, SUFFIXES)
    if not len(points) or not points.isfinite().all():
        raise ArgumentError(
            f"points: expected finite points to write {path.name}, got {len(points)} points, "
            f"{int((~points.isfinite()).any(-1).sum())} of them not finite"
        )
    if colors.is_floating_point():
        colors = (colors.clamp(0, 1) * 255).round().to(torch.uint8)
    vertices, levels = points.detach().cpu().numpy(), colors.detach().cpu().numpy()
    if path.suffix == ".ply":
        write_bytes(path, _ply(vertices, levels, None if normals is None else normals.detach().cpu().numpy()))
        return path
    import trimesh  # a second to import

    cloud = trimesh.PointCloud(vertices, colors=levels)
    with atomic_write(path) as temporary:
        cloud.export(temporary)
    return path


def _ply(points: npt.NDArray[Any], colors: npt.NDArray[Any], normals: npt.NDArray[Any] | None) -> bytes:
    """A binary PLY file of coloured points: a header in plain text, and 15 or 27 bytes for each, 12 more of float64."""
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(points)}\n"
    double = points.dtype == np.float64
    header += "".join(f"property {'double' if double else 'float'} {axis}\n" for axis in "xyz")
    fields: list[Any] = [("point", "<f8" if double else "<f4", 3)]
    if normals is not None:
        header += "".join(f"property float n{axis}\n" for axis in "xyz")
        fields.append(("normal", "<f4", 3))
    header += "".join(f"property uchar {channel}\n" for channel in ("red", "green", "blue"))
    rows = np.empty(len(points), [*fields, ("color", "u1", 3)])
    rows["point"], rows["color"] = points, colors
    if normals is not None:
        rows["normal"] = normals
    return f"{header}end_header\n".encode() + rows.tobytes()


@full_precision
def point_colors(
    rig: CameraRig, images: Mapping[str, Shaped[Tensor, "c _ _"]], points: Float[Tensor, "n 3"]
) -> tuple[Float[Tensor, "c n"], Bool[Tensor, " n"]]:
    """Return colours ``(c, n)`` of points ``(n, 3)``, zero where no camera sees them, and where one does ``(n,)``.

    Cameras count more near their axis. Occlusion is not known.

    Raises:
        ArgumentError: the images' names are not the cameras'.

    Examples:
        >>> from sphericalvision.cameras import ring_rig
        >>> rig = ring_rig(2, image_size=(8, 8))
        >>> colors, seen = point_colors(rig, {name: torch.ones(3, 8, 8) for name in rig.names}, 3 * torch.eye(3))
        >>> colors.shape, seen.tolist()
        (torch.Size([3, 3]), [True, True, True])
    """
    check_images_of(rig, images)
    if not len(points):
        return points.new_zeros(next(iter(images.values())).shape[0], 0), torch.zeros(0, dtype=torch.bool)
    projection = rig.project(points)
    channels = next(iter(images.values())).shape[0]
    total, weights = points.new_zeros(channels, len(points)), points.new_zeros(len(points))
    for index, (name, camera) in enumerate(rig.cameras.items()):
        (which,) = projection.valid[index].nonzero(as_tuple=True)
        colors = camera.interpolate(images[name].to(points), projection.pixels[index][which])
        ray = points[which] - rig.positions[index]
        forward = (ray @ rig.axes[index] / ray.norm(dim=-1) + 1) / 2
        weight = (forward.clamp(min=0.05) ** 8).to(total)  # what is behind a panorama's axis counts, too
        total = total.index_add(1, which, weight * colors)
        weights = weights.index_add(0, which, weight)
    return total / weights.clamp(min=1e-12), weights > 0
