# SPDX-License-Identifier: Apache-2.0
"""The four ideal fisheye projections."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, Literal, get_args

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from sphericalvision.cameras.base import Camera, Projection, Unprojection
from sphericalvision.cameras.checks import checked_size, model_function
from sphericalvision.cameras.declaration import Choice, ImageSize, Intrinsic, MaxAngle
from sphericalvision.cameras.fitting import fitted, shape_grid
from sphericalvision.cameras.models.image_plane import pixels_from_plane, plane_from_pixels
from sphericalvision.cameras.registry import register_camera
from sphericalvision.core import ArgumentError, check_choice, check_type
from sphericalvision.geometry import normalize
from sphericalvision.geometry.directions import (
    components,
    cosine_and_lifted_sinc,
    from_components,
    holds,
    lifted_radius,
    safe_sqrt,
)

FisheyeProjection = Literal["equidistant", "equisolid", "stereographic", "orthographic"]
FISHEYE_PROJECTIONS: tuple[str, ...] = get_args(FisheyeProjection)

_RADIUS: dict[str, Callable[[float], float]] = {  # image radius over focal length, from the angle
    "equidistant": lambda angle: angle,
    "equisolid": lambda angle: 2 * math.sin(angle / 2),
    "stereographic": lambda angle: 2 * math.tan(angle / 2),
    "orthographic": math.sin,
}
_WIDEST = {
    "equidistant": math.pi,
    "equisolid": math.pi,
    "stereographic": math.radians(179),  # at 180° its image is infinite
    "orthographic": math.pi / 2,
}


def _length_plus_z(x: Tensor, y: Tensor, z: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """|p| and |p| + z, the latter without cancellation behind the camera, and whether it is clearly above 0.

    It is not on the backward axis, where something small stands in for it. The camera's centre is moved
    forward a little.
    """
    limits = torch.finfo(z.dtype)
    squared = torch.addcmul(x * x, y, y)
    least = limits.tiny**0.25
    z = z + (least - torch.addcmul(squared, z, z) / least).clamp_min(0)
    length = torch.addcmul(squared, z, z).sqrt()
    twice_front = 2 * z.clamp_min(0)
    total = squared / (length + (twice_front - z)) + twice_front  # z + |z| + (|p| − |z|)
    least = limits.eps**1.5 * length
    return length, torch.maximum(total, least), total > least


@model_function
def project_fisheye(
    points: Float[Tensor, "*#batch 3"],
    focal_length: Float[Tensor, "*#batch #2"],
    principal_point: Float[Tensor, "*#batch 2"],
    projection: str = "equidistant",
) -> Projection:
    """Pixels (*, 2) of ``points`` (*, 3) through an ideal fisheye lens.

    Args:
        points: (*, 3) in the camera's frame, any length.
        focal_length: (*, 1) or (*, 2) in pixels, broadcastable.
        principal_point: (*, 2) as (u, v).
        projection: the image radius as a function of the angle θ from the axis: ``"equidistant"`` f·θ, ``"equisolid"``
            2f·sin(θ/2), ``"stereographic"`` 2f·tan(θ/2), ``"orthographic"`` f·sin θ (valid up to 90°).

    Raises:
        ArgumentError: unknown ``projection``.

    References:
        D. Schneider et al., "Validation of geometric models for fisheye lenses", ISPRS J. 64 (2009), eqs. 1-5.

    Examples:
        >>> right = torch.tensor([1.0, 0.0, 0.0])  # 90° from the axis
        >>> pixels, valid = project_fisheye(right, torch.tensor([100.0]), torch.tensor([320.0, 240.0]))
        >>> [round(value, 2) for value in pixels.tolist()], valid.item()
        ([477.08, 240.0], True)
    """
    check_choice("projection", projection, FISHEYE_PROJECTIONS)
    x, y, z = components(points)
    if projection == "equidistant":
        radius = lifted_radius(x, y, z)
        scale = torch.atan2(radius, z) / radius
        # Not on the backward axis, where the azimuth is rounding.
        valid = torch.maximum(radius, z) > 2 * torch.finfo(z.dtype).eps * z.abs()
    else:
        length, length_plus_z, valid = _length_plus_z(x, y, z)
        if projection == "equisolid":
            scale = (0.5 * length * length_plus_z).rsqrt()
        elif projection == "stereographic":
            scale = 2 / length_plus_z
        else:
            scale = 1 / length
            valid = z >= 0
    return Projection(pixels_from_plane(x * scale, y * scale, focal_length, principal_point), valid)


@model_function
def unproject_fisheye(
    pixels: Float[Tensor, "*#batch 2"],
    focal_length: Float[Tensor, "*#batch #2"],
    principal_point: Float[Tensor, "*#batch 2"],
    projection: str = "equidistant",
) -> Unprojection:
    """Unit directions (*, 3) of ``pixels`` (*, 2): the inverse of ``project_fisheye``, with the same arguments.

    Examples:
        >>> centre = torch.tensor([320.0, 240.0])
        >>> unproject_fisheye(centre, torch.tensor([100.0]), centre).directions.tolist()
        [0.0, 0.0, 1.0]
    """
    check_choice("projection", projection, FISHEYE_PROJECTIONS)
    x, y = plane_from_pixels(pixels, focal_length, principal_point)
    squared = torch.addcmul(x * x, y, y)
    if projection == "equidistant":
        cosine, scale = cosine_and_lifted_sinc(squared)
        valid = squared <= math.pi**2
    elif projection == "equisolid":
        cosine, scale = 1 - squared / 2, safe_sqrt(1 - squared / 4)
        valid = squared <= 4
    elif projection == "stereographic":
        scale = 1 / (1 + squared / 4)
        cosine = (1 - squared / 4) * scale
        valid = torch.isfinite(squared)
    else:
        cosine, scale = safe_sqrt(1 - squared), torch.ones_like(squared)
        valid = squared <= 1
    directions = from_components(x * scale, y * scale, cosine)
    if projection in ("equisolid", "orthographic"):  # beyond the edge the formulas leave the sphere
        directions = normalize(directions)
    return Unprojection(directions, valid)


def _along_both(focal_length: Any, principal_point: Any) -> Any:
    """The focal lengths with a last dimension: one for both directions or, where there are two, one for each."""
    shape, batch = _shape_of(focal_length), _shape_of(principal_point)[:-1]
    if shape and shape[-1] in (1, 2) and shape != batch:
        return focal_length
    if shape == batch and shape and shape[-1] == 2:  # read one way or the other
        first, second = torch.as_tensor(focal_length).detach().unbind(-1)
        if not holds(first == second):
            raise ArgumentError(
                f"focal_length: shape {shape} with a batch of {batch} cameras is one number for each camera or one for "
                f"each direction; write {(*shape, 1)} or {(1,) * len(batch) + (2,)}"
            )
    if isinstance(focal_length, Tensor):
        return focal_length.unsqueeze(-1)
    return np.asarray(focal_length)[..., None].tolist()


def _shape_of(values: Any) -> tuple[int, ...]:
    return tuple(values.shape) if isinstance(values, Tensor) else np.shape(values)


@register_camera
class FisheyeCamera(Camera):
    """An ideal fisheye camera; see ``project_fisheye``.

    A batch may have one focal length a camera, (*b,), or different scales along u and v, (*b, 2).

    Examples:
        >>> camera = FisheyeCamera.from_field_of_view((800, 800), math.radians(220))
        >>> pixels, valid = camera.project(torch.tensor([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]]))
        >>> valid.tolist(), pixels[0].tolist()
        ([True, True, False], [399.5, 399.5])
    """

    model = "fisheye"
    functions = project_fisheye, unproject_fisheye

    projection: Choice = Choice(*FISHEYE_PROJECTIONS)
    focal_length: Intrinsic = Intrinsic(1, 2, above=0, unit="pixels", named="fx fy")
    principal_point: Intrinsic = Intrinsic(2, named="cx cy")
    image_size: ImageSize = ImageSize()
    max_angle: MaxAngle = MaxAngle(default=None)

    def _fill(self, values: dict[str, Any]) -> None:
        super()._fill(
            values | {"focal_length": _along_both(values["focal_length"], values["principal_point"])}
        )

    def _model_end(self) -> Tensor:
        return torch.full_like(self.max_angle, _WIDEST[self.projection])

    @classmethod
    def from_field_of_view(
        cls,
        image_size: Sequence[int],
        field_of_view: float,
        projection: str = "equidistant",
        dtype: torch.dtype | None = None,
    ) -> FisheyeCamera:
        """The camera whose image circle of ``field_of_view`` radians touches the shorter sides of the image.

        Raises:
            ArgumentError: the projection cannot show such a field of view.

        Examples:
            >>> FisheyeCamera.from_field_of_view((768, 800), math.radians(220)).focal_length.item()
            200.0...
        """
        check_choice("projection", projection, FISHEYE_PROJECTIONS)
        widest = _WIDEST[projection]
        check_type(
            "field_of_view",
            field_of_view,
            (int, float),
            "radians across the shorter side, as math.radians(220)",
        )
        if not 0 < field_of_view <= 2 * widest + 1e-9:
            raise ArgumentError(
                f"field_of_view: expected up to {math.degrees(2 * widest):.0f}° ({2 * widest:.4f} rad) for an "
                f"{projection} lens, got {math.degrees(field_of_view):.1f}° ({field_of_view} rad)"
            )
        height, width = checked_size(image_size)
        focal_length = min(height, width) / 2 / _RADIUS[projection](field_of_view / 2)
        principal_point = torch.tensor([(width - 1) / 2, (height - 1) / 2], dtype=dtype)
        return cls(projection, focal_length, principal_point, image_size, min(field_of_view / 2, widest))


fitted(
    FisheyeCamera,
    shape_grid(),
    projections=FISHEYE_PROJECTIONS,
    sizes={"focal_length": 2},
    reach=lambda projection: _WIDEST[projection],
)
