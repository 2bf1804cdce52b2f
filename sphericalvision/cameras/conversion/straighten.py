# SPDX-License-Identifier: Apache-2.0
"""The turn of an OCam image about the axis, as a turn of the camera in its place."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from sphericalvision.cameras.base import Camera, check_single
from sphericalvision.cameras.models.ocam import OCamCamera
from sphericalvision.cameras.rig import CameraRig


class Straightened(NamedTuple):
    """A camera whose image is not turned, and its frame."""

    camera: Camera
    """The same lens: ``camera.project(old_from_new.T @ point)`` is what the old one made of ``point``."""
    old_from_new: Float[Tensor, "3 3"]
    """The rotation about the axis; ``world_from_new`` is ``world_from_old @ old_from_new``."""
    angle: float
    """Of the rotation, in radians; 0 for a camera of any other model."""


@torch.no_grad()
def straighten(camera: Camera) -> Straightened:
    """Take the turn out of an OCam camera's affine map, and say how to turn the camera for it.

    Calibrations often have d ≈ −e, which turns the image by a degree or two. No other model has that; as a turn of the
    camera it fits all. What is left of the map is symmetric (polar decomposition): two scales and a shear that is half
    of d + e. Both are the same lens to rounding. Cameras of other models are returned as they are.

    Args:
        camera: a single camera.

    Raises:
        ArgumentError: the camera is a batch.

    Examples:
        >>> lens = OCamCamera([-200.0, 0.0, 1e-3], None, [159.5, 119.5], [1.0, 0.02, -0.02], (240, 320), 1.5)
        >>> straight = straighten(lens)
        >>> round(math.degrees(straight.angle), 3), straight.camera.affine[1:].abs().max().item() < 1e-8
        (1.146, True)
    """
    check_single(camera)
    identity = torch.eye(3, dtype=torch.float64, device=camera.device)
    if not isinstance(camera, OCamCamera):
        return Straightened(camera, identity.to(camera.dtype), 0.0)
    c, d, e = camera.affine.double().tolist()
    angle = math.atan2(d - e, 1 + c)
    cosine, sine = math.cos(angle), math.sin(angle)
    rotation2 = identity.new_tensor([[cosine, -sine], [sine, cosine]])
    (across, shear), (_, down) = (identity.new_tensor([[1.0, e], [d, c]]) @ rotation2.T).tolist()
    power = torch.arange(camera.polynomial.shape[-1], dtype=torch.float64, device=camera.device)
    inverse = camera.inverse_polynomial
    straight = OCamCamera(
        camera.polynomial.double() * across ** (1 - power),  # the radius is measured along u, which scales
        None if inverse is None else inverse.double() * across,
        camera.principal_point.double(),
        [down / across, shear / across, shear / across],
        camera.image_size,
        camera.max_angle.double(),
    )
    rotation = identity.clone()
    rotation[:2, :2] = rotation2.T
    return Straightened(straight.to(camera.dtype), rotation.to(camera.dtype), angle)


@torch.no_grad()
def straighten_rig(rig: CameraRig) -> CameraRig:
    """The same rig with the turns of its OCam images in the poses of its cameras; see ``straighten``.

    Examples:
        >>> lens = OCamCamera([-200.0, 0.0, 1e-3], None, [159.5, 119.5], [1.0, 0.02, -0.02], (240, 320), 1.5)
        >>> rig = straighten_rig(CameraRig([lens], torch.eye(4)[None]))
        >>> rig.world_from_camera[0, :2, :2]
        tensor([[ 0.9998,  0.0200],
                [-0.0200,  0.9998]])
    """
    check_single(rig)
    straight = {name: straighten(camera) for name, camera in rig.cameras.items()}
    poses = rig.world_from_camera.double()
    rotations = torch.stack([upright.old_from_new for upright in straight.values()]).to(poses)
    poses = torch.cat((poses[:, :3, :3] @ rotations, poses[:, :3, 3:]), -1)
    poses = torch.cat((poses, rig.world_from_camera[:, 3:].double()), 1).to(rig.world_from_camera.dtype)
    return rig.replaced({name: upright.camera for name, upright in straight.items()}, poses)
