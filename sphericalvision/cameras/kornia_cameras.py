# SPDX-License-Identifier: Apache-2.0
"""Cameras to and from Kornia's, and cameras as modules whose intrinsics are learned.

Convention:
    Kornia's cameras have the axes and pixels of this package. Its lens models end at 90° from the axis.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from sphericalvision.cameras.base import Camera, Projection, Unprojection
from sphericalvision.cameras.models.brown_conrady import BrownConradyCamera
from sphericalvision.cameras.models.kannala_brandt import KannalaBrandtCamera
from sphericalvision.cameras.models.pinhole import PinholeCamera
from sphericalvision.core import ArgumentError

_COEFFICIENTS = {"PINHOLE": 0, "BROWN_CONRADY": 8, "KANNALA_BRANDT_K3": 4}
"""Kornia's models, and how many numbers stand behind fx fy cx cy."""


def to_kornia(camera: Camera) -> Any:
    """The camera as Kornia's ``CameraModel``.

    Args:
        camera: a ``PinholeCamera``, a ``BrownConradyCamera`` of up to eight coefficients or a ``KannalaBrandtCamera``
            of four. A single one, or a batch (b,).

    Raises:
        ArgumentError: Kornia has no such camera.

    Examples:
        >>> to_kornia(PinholeCamera([500.0, 500.0], [319.5, 239.5], (480, 640))).params
        tensor([500.0000, 500.0000, 319.5000, 239.5000])
    """
    from kornia.image import ImageSize  # kornia takes a second to import
    from kornia.sensors.camera import CameraModel, CameraModelType

    height, width = camera.image_size
    kinds = PinholeCamera | BrownConradyCamera | KannalaBrandtCamera
    if not isinstance(camera, kinds) or len(camera.batch_shape) > 1:
        raise ArgumentError(
            f"camera: Kornia has pinhole, Brown-Conrady and Kannala-Brandt cameras and batches (b,), got {camera!r}; "
            "convert the camera first: convert(camera, to=...)"
        )
    name, coefficients = _model(camera)
    params = torch.cat((camera.focal_length, camera.principal_point, coefficients), -1)
    return CameraModel(ImageSize(height, width), CameraModelType[name], params)


def _model(camera: PinholeCamera | BrownConradyCamera | KannalaBrandtCamera) -> tuple[str, Tensor]:
    """Kornia's name of the model, and its coefficients (*b, k)."""
    names = {PinholeCamera: "PINHOLE", BrownConradyCamera: "BROWN_CONRADY"}
    name = next((names[kind] for kind in names if isinstance(camera, kind)), "KANNALA_BRANDT_K3")
    if camera.skew is not None:
        raise ArgumentError(
            f"camera: Kornia's {name} has no skew, this one has; set it to None, or convert to OCam"
        )
    if isinstance(camera, PinholeCamera):
        return name, camera.focal_length[..., :0]
    most, distortion = _COEFFICIENTS[name], camera.distortion
    if bool((distortion.detach()[..., most:] != 0).any()):
        raise ArgumentError(f"camera: Kornia's {name} has {most} coefficients, got {distortion.tolist()}")
    return name, torch.nn.functional.pad(distortion[..., :most], (0, max(0, most - distortion.shape[-1])))


def from_kornia(camera: Any) -> Camera:
    """A camera of Kornia's, a ``PinholeCamera`` or a ``CameraModel``, as one of this package; a pose is left out.

    A batch of one is one camera. The pose of a ``PinholeCamera`` is its ``extrinsics``, camera_from_world.

    Raises:
        ArgumentError: it is another thing, an orthographic camera, or cameras of several image sizes.

    Examples:
        >>> camera = KannalaBrandtCamera([190.0, 190.0], [255.0, 257.0], [0.01, 0.0, 0.0, 0.0], (512, 512), 1.4)
        >>> from_kornia(to_kornia(camera)).distortion
        tensor([0.0100, 0.0000, 0.0000, 0.0000])
    """
    from kornia.geometry.camera import PinholeCamera as KorniaPinhole
    from kornia.sensors.camera import CameraModel
    from kornia.sensors.camera.camera_model import CameraModelBase

    if isinstance(camera, KorniaPinhole):
        matrix, sides = camera.intrinsics, torch.stack((camera.height, camera.width), -1).reshape(-1, 2)
        if not bool((sides == sides[0]).all()):
            raise ArgumentError(f"camera: expected images of one size, got {sides.tolist()} (height, width)")
        focal_length = torch.stack((matrix[:, 0, 0], matrix[:, 1, 1]), -1)
        size = [int(side) for side in sides[0]]
        skew = matrix[:, 0, 1] if bool((matrix[:, 0, 1] != 0).any()) else None
        result = PinholeCamera(focal_length, matrix[:, :2, 2], size, skew=skew)
        return result.select(0) if len(matrix) == 1 else result
    if isinstance(camera, CameraModel):
        camera = camera._model
    if isinstance(camera, CameraModelBase):
        sizes = (int(camera.image_size.height), int(camera.image_size.width))
        focal_length, center, k = camera.params.split((2, 2, camera.params.shape[-1] - 4), -1)
        name = type(camera).__name__
        if name == "PinholeModel":
            return PinholeCamera(focal_length, center, sizes)
        if name == "BrownConradyModel":
            return BrownConradyCamera(focal_length, center, k, sizes)
        if name == "KannalaBrandtK3":
            return KannalaBrandtCamera(focal_length, center, k, sizes)
    raise ArgumentError(
        "camera: expected Kornia's PinholeCamera, or its CameraModel but an orthographic one, got "
        f"{type(camera).__name__}"
    )


class CameraModule(nn.Module):
    """A camera whose intrinsics are parameters: it moves with ``.to``, is in state dicts, and optimisers find them.

    Convention:
        The module is called as ``camera.project``. Intrinsics are not kept in their bounds: use a small learning rate,
        or none for those that are ``fixed``.

    Args:
        camera: a single camera or a batch.
        fixed: names of intrinsics that become buffers in place of parameters.

    Raises:
        ArgumentError: ``fixed`` names no intrinsic of the camera.

    Examples:
        >>> truth = PinholeCamera([510.0, 510.0], [319.5, 239.5], (480, 640))
        >>> points = torch.tensor([[0.1, 0.2, 1.0], [-0.3, 0.1, 1.0]])
        >>> module = CameraModule(PinholeCamera([500.0, 500.0], [319.5, 239.5], (480, 640)), fixed=["principal_point"])
        >>> optimizer = torch.optim.SGD(module.parameters(), lr=5.0)
        >>> for _ in range(100):
        ...     loss = (module(points).pixels - truth.project(points).pixels).square().mean()
        ...     optimizer.zero_grad()
        ...     loss.backward()
        ...     optimizer.step()
        >>> module.camera.focal_length.detach().round().tolist()
        [510.0, 510.0]
    """

    max_angle: Tensor

    def __init__(self, camera: Camera, fixed: Sequence[str] = ()) -> None:
        super().__init__()
        names = [name for name in camera.intrinsic_names if getattr(camera, name) is not None]
        unknown = set(fixed) - set(names)
        if unknown:
            raise ArgumentError(
                f"fixed: this camera has {', '.join(names)}, not {', '.join(sorted(unknown))}"
            )
        self._camera = camera
        for name in names:
            value = getattr(camera, name).detach().clone()
            if name in fixed:
                self.register_buffer(name, value)
            else:
                self.register_parameter(name, nn.Parameter(value))
        self.register_buffer("max_angle", camera.max_angle.detach().clone())
        self._names = (*names, "max_angle")

    @property
    def camera(self) -> Camera:
        """The camera of the present parameters, through which gradients reach them."""
        return self._camera.with_intrinsics({name: getattr(self, name) for name in self._names})

    def forward(self, points: Float[Tensor, "*points 3"]) -> Projection:
        """Pixels of ``points`` (*, 3), and whether the camera sees them; see ``Camera.project``."""
        return self.camera.project(points)

    def unproject(self, pixels: Float[Tensor, "*pixels 2"]) -> Unprojection:
        """Directions of ``pixels`` (*, 2); see ``Camera.unproject``."""
        return self.camera.unproject(pixels)

    def extra_repr(self) -> str:
        """The camera."""
        degrees = math.degrees(2 * float(self.max_angle.max()))
        return f"{type(self._camera).__name__}, image_size={self._camera.image_size}, field of view {degrees:.1f}°"
