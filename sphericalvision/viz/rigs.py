# SPDX-License-Identifier: Apache-2.0
"""Drawings of a rig in 3D and from above, and of its coverage of the sphere."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import matplotlib
import numpy as np
import torch
from torch import Tensor

from sphericalvision.cameras import Camera, CameraRig, coverage, overlap
from sphericalvision.cameras.base import check_single
from sphericalvision.cameras.field_of_view import directions_around_axis, visible_angle
from sphericalvision.core import check_type
from sphericalvision.geometry import longitude_latitude_from_directions
from sphericalvision.sphere import Equirectangular
from sphericalvision.viz.color import Picture
from sphericalvision.viz.figure import figure_pixels

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from mpl_toolkits.mplot3d import Axes3D

_WIDTH, _DPI = 5, 150  # inches: letters can be read on a telephone, too
_ROUND = torch.linspace(0, 2 * math.pi, 181, dtype=torch.float64)


@torch.no_grad()
def rig_picture(rig: CameraRig) -> Picture:
    """Draw a rig in 3D and, below, from above: positions, axes and fields of view.

    In 3D a field of view is the curve of its edge on a sphere around the camera, behind it if wider than 180°. The axes
    x, y and z of the cameras and of the rig are red, green and blue, and the length of the squares on the ground is
    written next to them. From above a field of view is the part of the horizontal plane that the camera sees.

    Args:
        rig: single.

    Returns:
        uint8 ``(h, w, 3)``, RGB.

    Examples:
        >>> from sphericalvision.cameras import ring_rig
        >>> rig_picture(ring_rig(4)).shape[-1]
        3
    """
    from matplotlib.figure import Figure

    check_type("rig", rig, CameraRig)
    check_single(rig)
    rig = rig.to("cpu", torch.float64)
    positions = rig.positions - rig.center
    baseline = float(rig.baselines.max())
    length = 0.5 * baseline if baseline > 0 else 0.1
    reach = float(positions.norm(dim=-1).max()) + 1.6 * length
    figure = Figure(figsize=(_WIDTH, 9), dpi=_DPI)
    space: Axes3D = figure.add_axes((-0.25, 0.52, 1.5, 0.48), projection="3d", computed_zorder=False)
    plan = figure.add_axes((0.14, 0.06, 0.84, 0.84 * _WIDTH / 9))
    _frame(space, plan, reach, float(positions[:, 1].abs().max()) + 1.1 * length)
    _draw_axes(space, torch.zeros(3, dtype=torch.float64), torch.eye(3, dtype=torch.float64), 0.6 * length)
    colors = matplotlib.color_sequences["tab10"]
    for index, (name, camera) in enumerate(rig.cameras.items()):
        color = colors[index % len(colors)]
        position, rotation = positions[index], rig.world_from_camera[index, :3, :3]
        edge = directions_around_axis(visible_angle(camera, _ROUND), _ROUND) @ rotation.mT * length + position
        tip = position + 1.3 * length * rotation[:, 2]
        _draw_3d(space, edge, color=color, linewidth=1.4)
        for corner in edge[:-1:15]:
            _draw_3d(space, torch.stack((position, corner)), color=color, linewidth=0.5, alpha=0.5)
        _draw_axes(space, position, rotation, 0.6 * length)
        _draw_3d(space, position[None], color=color, marker="o", markersize=5)
        _write_3d(space, tip, name, color=color, fontsize=10, ha="center", va="center")
        _draw_plan(plan, camera, rotation, position, 1.6 * length, color)
        plan.plot(*torch.stack((position, tip))[:, [0, 2]].T.tolist(), color=color, linewidth=2.2)
        plan.plot(position[0], position[2], "o", color=color, markersize=5)
        plan.annotate(
            name, (float(tip[0]), float(tip[2])), color=color, fontsize=10, ha="center", va="bottom"
        )
    figure.suptitle(f"{len(rig)} cameras, largest baseline {baseline:.3f} m", fontsize=11, y=0.97)
    figure.text(0.5, 0.93, "axes: x right (red), y down (green), z ahead (blue)", fontsize=9, ha="center")
    return figure_pixels(figure)


@torch.no_grad()
def coverage_panorama(
    rig: CameraRig, depth: float = math.inf, height: int = 180, title: str | None = None
) -> Picture:
    """Draw how many cameras see each direction at one depth, as an equirectangular map with the cameras' axes.

    Args:
        rig: single.
        depth: metres from the rig's centre.
        height: rows of the map; it has twice as many columns.
        title: text above the picture.

    Returns:
        uint8 ``(h, w, 3)``, RGB.

    Examples:
        >>> from sphericalvision.cameras import ring_rig
        >>> coverage_panorama(ring_rig(4), depth=2.0, height=40).dtype
        dtype('uint8')
    """
    from matplotlib.figure import Figure
    from matplotlib.patches import Patch

    check_single(rig)
    rig = rig.to("cpu", torch.float64)
    grid = Equirectangular(height, 2 * height, dtype=torch.float64)
    solid_angles = grid.solid_angles.flatten()
    counts = coverage(rig, grid.directions.reshape(-1, 3), [depth])[0]
    seen, shared, mean = overlap(counts, solid_angles)
    colors = matplotlib.colormaps["viridis"](np.linspace(0.1, 1, max(len(rig), 1)))
    palette = np.concatenate(([[0.75, 0.75, 0.75, 1.0]], colors))
    figure = Figure(figsize=(_WIDTH, 4), dpi=_DPI)
    axes = figure.add_axes((0.14, 0.3, 0.82, 0.58))
    picture = palette[counts.reshape(grid.shape).numpy()]
    axes.imshow(picture, extent=(-180, 180, -90, 90), interpolation="nearest", aspect="equal")
    longitude, latitude = longitude_latitude_from_directions(rig.axes)
    for name, x, y in zip(rig.names, longitude.rad2deg().tolist(), latitude.rad2deg().tolist(), strict=True):
        axes.plot(x, y, "o", markerfacecolor="white", markeredgecolor="black", markersize=6)
        axes.annotate(
            name,
            (x, y),
            xytext=(0, -7 if y > 0 else 7),
            textcoords="offset points",
            ha="right" if x > 140 else "left" if x < -140 else "center",
            va="top" if y > 0 else "bottom",
            fontsize=9,
            bbox={"facecolor": "white", "alpha": 0.7, "edgecolor": "none", "pad": 1},
        )
    fractions = torch.zeros(len(rig) + 1, dtype=torch.float64).index_add(0, counts, solid_angles) / (
        4 * math.pi
    )
    patches = [
        Patch(color=palette[number], label=f"{number}: {100 * part:.1f} %")
        for number, part in enumerate(fractions.tolist())
    ]
    axes.legend(
        handles=patches,
        title="cameras that look there: share of the sphere",
        loc="upper center",
        bbox_to_anchor=(0.44, -0.2),
        ncols=min(len(patches), 3),
        frameon=False,
        fontsize=9,
        title_fontsize=9,
    )
    axes.set(xlabel="longitude (degrees; right is +)", ylabel="latitude (degrees)")
    axes.set_xticks(range(-180, 181, 90))
    axes.set_yticks(range(-90, 91, 30))
    where = "far away" if math.isinf(depth) else f"at {depth:g} m"
    numbers = f"{where}: {100 * seen:.1f} % seen, {100 * shared:.1f} % by two or more,\n{mean:.2f} cameras on average"
    axes.set_title(f"{title}\n{numbers}" if title else numbers, fontsize=10)
    return figure_pixels(figure)


def _draw_3d(axes: Axes3D, points: Tensor, **style: Any) -> None:
    """A line through points (n, 3) of the world; matplotlib's third axis points up, ours (y) down."""
    x, y, z = points.T.tolist()
    axes.plot(x, z, [-value for value in y], **style)


def _draw_axes(axes: Axes3D, origin: Tensor, rotation: Tensor, length: float) -> None:
    """The axes x, y and z that are the columns of a rotation."""
    for direction, color in zip(rotation.T, ("red", "green", "blue"), strict=True):
        _draw_3d(axes, torch.stack((origin, origin + length * direction)), color=color, linewidth=1.8)


def _write_3d(axes: Axes3D, point: Tensor, text: str, **style: Any) -> None:
    """Text at a point of the world."""
    x, y, z = point.tolist()
    axes.text(x, z, -y, text, **style)


def _draw_plan(
    axes: Axes, camera: Camera, rotation: Tensor, position: Tensor, length: float, color: Any
) -> None:
    """The directions of the horizontal plane that a camera sees, as sectors of a circle."""
    longitude = torch.linspace(-math.pi, math.pi, 721, dtype=torch.float64)
    level = torch.stack((longitude.sin(), 0 * longitude, longitude.cos()), dim=-1)
    seen = camera.project(level @ rotation).valid.numpy()
    rim = (position + length * level)[:, [0, 2]].numpy()
    center = position[[0, 2]].numpy()
    edges = np.flatnonzero(np.diff(np.concatenate(([False], seen, [False])).astype(int)))
    for first, last in zip(edges[::2], edges[1::2], strict=True):
        sector = np.concatenate((center[None], rim[first:last]))
        axes.fill(*sector.T, color=color, alpha=0.15, linewidth=0)
        axes.plot(*rim[first:last].T, color=color, linewidth=1.2)


def _frame(space: Axes3D, plan: Axes, reach: float, height: float) -> None:
    """The same square for both pictures; in 3D it is the ground, ``height`` below and above the rig."""
    limits = (-reach, reach)
    space.set(xlim=limits, ylim=limits, zlim=(-height, height))
    space.set_box_aspect((1, 1, height / reach), zoom=1.3 * min(1, 0.6 * reach / height))
    space.set_axis_off()
    space.view_init(elev=28, azim=-62)
    power = 10.0 ** math.floor(math.log10(reach / 2))
    side = power * max(digit for digit in (1, 2, 5) if digit * power <= reach / 2)
    for place in side * torch.arange(-int(reach / side), int(reach / side) + 1):
        for turned in ((0, 1), (1, 0)):
            line = torch.tensor([[place, -reach], [place, reach]])[:, turned]
            ends = torch.stack((line[:, 0], torch.full((2,), height), line[:, 1]), -1)
            _draw_3d(space, ends, color="0.8", linewidth=0.7)
    corner = torch.tensor([0.0, height, -reach])
    _draw_3d(space, torch.stack((corner, corner + torch.tensor([side, 0, 0]))), color="black", linewidth=2.4)
    _write_3d(
        space, corner + torch.tensor([0.5 * side, 0.0, -0.1 * reach]), f"{side:g} m", fontsize=10, va="top"
    )
    plan.set(xlim=limits, ylim=limits, xlabel="x right (m)", ylabel="z ahead (m)", title="from above")
    plan.set_aspect("equal")
    plan.grid(alpha=0.3)
