# SPDX-License-Identifier: Apache-2.0
"""Where a rig is in another frame: that of a robot, whose axes are others, and whether it lies on its side."""

from __future__ import annotations

import math
import re
import warnings
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from sphericalvision.cameras.rig import CameraRig
from sphericalvision.core import ArgumentError, check_file
from sphericalvision.io.comments import warn_of_comments
from sphericalvision.kernels import full_precision

OPTICAL_FROM_ROS = torch.tensor(
    [[0.0, -1.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
)
"""From a robot's axes, x forward, y left, z up (REP 103), to x right, y down, z forward."""
FAR = 50.0
"""Metres between a rig and the frame of what carries it, from which on the unit is asked about."""
CERTAIN = 0.5
"""Length of the mean of unit vectors from which on they agree about a direction."""


@full_precision
def placed(rig: CameraRig, transform: Float[Tensor, "4 4"]) -> CameraRig:
    """The rig in another world.

    Args:
        rig: in its own.
        transform: ``(4, 4)``, from its world to the other.

    Examples:
        >>> from sphericalvision.cameras import ring_rig
        >>> base_from_rig = torch.linalg.inv(OPTICAL_FROM_ROS)
        >>> base_from_rig[2, 3] = 1.5  # metres above base_link
        >>> placed(ring_rig(4), base_from_rig).positions[0]  # the camera in front
        tensor([0.2000, 0.0000, 1.5000])
    """
    transform = transform.to(rig.world_from_camera)
    turned = rig.rotated(rotation=transform[:3, :3])
    poses = turned.world_from_camera.clone()
    poses[..., :3, 3] += transform[:3, 3]
    return turned.replaced(world_from_camera=poses)


def read_pose(path: str | Path, key: str) -> Float[Tensor, "4 4"]:
    """The one pose ``(4, 4)`` of a file: 3 or 4 rows of a matrix, in lines or in one, or a line of TUM's.

    Commas and brackets may stand around numbers, as numpy and JSON print matrices.

    Args:
        path: of the file.
        key: that it was given by, for messages.

    Raises:
        ArgumentError: the file holds several.
        FileFormatError: it holds none.
    """
    from sphericalvision.cameras.calibration.parsing import numbers
    from sphericalvision.cameras.calibration.poses import transform_from_rows
    from sphericalvision.cameras.calibration.trajectories import read_trajectory

    lines = check_file(path, "a pose").read_bytes().decode(errors="replace").splitlines()
    warn_of_comments(Path(path), lines)
    rows = [re.sub(r"[\[\](),;]|\barray\b", " ", line.split("#")[0]).split() for line in lines]
    entries = [entry for row in rows for entry in row]
    if {len(row) for row in rows if row} in ({4}, {12}, {16}) and len(entries) in (12, 16):
        poses = transform_from_rows(numbers(entries, str(path)), str(path))[None]
    else:
        poses = read_trajectory(path).world_from_camera
    if len(poses) != 1:
        raise ArgumentError(
            f"{key}: expected one pose, a matrix of 3 or 4 rows of 4 numbers or a line 'time x y z qx qy qz qw', got "
            f"{len(poses)} in {path}"
        )
    if (distance := float(poses[0, :3, 3].norm())) > FAR:
        warnings.warn(
            f"{key}: {path} is {distance:.4g} m away; expected metres, are these millimetres?", stacklevel=3
        )
    return poses[0]


def tilt_of(rig: CameraRig) -> float | None:
    """Radians from the world's down to the cameras' mean down; None where they do not agree about one.

    Examples:
        >>> from sphericalvision.cameras import ring_rig
        >>> tilt_of(ring_rig(4)), round(math.degrees(tilt_of(placed(ring_rig(4), torch.linalg.inv(OPTICAL_FROM_ROS)))))
        (0.0, 90)
    """
    down = rig.world_from_camera[:, :3, 1].double().mean(0)
    if float(down.norm()) < CERTAIN:
        return None
    return math.atan2(float(down[[0, 2]].norm()), float(down[1]))
