# SPDX-License-Identifier: Apache-2.0
"""Checks of what cameras and rigs are made of, sizes of images, intrinsics, angles, poses, and of their precision.

Convention:
    Cameras compute in float32 or float64, whatever they are given. Points and pixels in float16 or bfloat16 are taken
    as the numbers that they are, and the answer is float32: in half precision pixel coordinates would be off by up to a
    few pixels. Integers are refused, and so are intrinsics in half precision.
"""

from __future__ import annotations

import functools
import inspect
import operator
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import torch
from jaxtyping import Float, Shaped
from torch import Tensor

from sphericalvision.core import (
    ArgumentError,
    ShapeError,
    check_floating,
    check_last_dim,
    check_tensor,
    short_repr,
)
from sphericalvision.geometry.directions import has_numbers, holds, moderate_lengths

HALF = (torch.float16, torch.bfloat16)
_PAIRS = ("image_size", "latitudes", "longitudes")  # of plain numbers
MAX_PIXELS = 2**27
"""Of the largest image of a camera, as of the largest file that is read: directions of its pixels take 1.5 GB."""
PLAUSIBLE = (0.005, 5.0)
"""Metres: radii of rigs and of windows; of others the positions have another unit."""

AnyFunction = TypeVar("AnyFunction", bound=Callable[..., Any])


def at_least_float32(name: str, values: Shaped[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """``values`` (*), in float32 if they are in half precision.

    Raises:
        ArgumentError: they are integers.

    Examples:
        >>> at_least_float32("points", torch.zeros(3, dtype=torch.bfloat16)).dtype
        torch.float32
    """
    check_floating(name, values)
    return values.float() if values.dtype in HALF else values


def model_function(function: AnyFunction) -> AnyFunction:
    """Decorate a function of ``points`` (*, 3) or ``pixels`` (*, 2) and intrinsics.

    It gets no half precision, and no points so long or so short that their squares overflow or vanish.

    It then raises ``ShapeError`` where the last dimension is another one, and ``ArgumentError`` for
    integers and for lists in place of tensors.
    """
    names = tuple(inspect.signature(function).parameters)
    size = {"points": 3, "pixels": 2}[names[0]]

    @functools.wraps(function)
    def checked(*arguments: Any, **options: Any) -> Any:
        values: Any = arguments[0] if arguments else options.get(names[0])
        check_last_dim(names[0], values, size)
        values = at_least_float32(names[0], values)
        values = moderate_lengths(values) if size == 3 else values
        for name, value in zip(names, arguments, strict=False):
            if isinstance(value, list | tuple) and name not in _PAIRS:  # would be indexed as tensors are
                check_tensor(name, value, "(*,) or (*, n)")
        options = {key: _raised(value) for key, value in options.items()}
        if not arguments:
            return function(**options | {names[0]: values})
        return function(values, *(_raised(value) for value in arguments[1:]), **options)

    return checked  # type: ignore[return-value]


def _raised(value: Any) -> Any:
    return value.float() if isinstance(value, Tensor) and value.dtype in HALF else value


def check_image(
    name: str,
    image: Shaped[Tensor, " ..."],
    image_size: tuple[int, ...],
    shape: str = "(*b, c, h, w)",
    remedy: str = "resize the image or use the calibration of this image size",
) -> None:
    """Raise ``ShapeError`` unless ``image`` is as high and wide as a camera's images, with channels if ``shape`` has.

    Examples:
        >>> check_image("image", torch.zeros(3, 4, 8), (4, 8))
    """
    check_tensor(name, image, shape)
    if image.ndim > shape.count("c, ") + 1 and tuple(image.shape[-2:]) == image_size:
        return
    height, width = image_size
    if "c, " in shape and tuple(image.shape) == image_size:
        remedy = f"a grey image has a channel, too: {name}[None]"
    elif "c, " in shape and tuple(image.shape[-3:-1]) == image_size:
        remedy = f"channels come first: {name}.movedim(-1, -3)"
    raise ShapeError(
        f"{name}: this camera's images are {height} x {width} (height x width), got shape {tuple(image.shape)}; "
        f"{remedy}"
    )


def check_precision(dtype: torch.dtype) -> None:
    """Raise ``ArgumentError`` for half precision, which cannot hold intrinsics."""
    if dtype in HALF:
        raise ArgumentError(
            f"dtype: cameras keep their intrinsics in float32 or float64, got {dtype}; points and images may be in "
            "half precision"
        )


def checked_numbers(name: str, value: Any, like: Float[Tensor, " ..."]) -> Float[Tensor, " ..."]:
    """A tensor of finite numbers."""
    try:
        tensor = torch.as_tensor(value, dtype=like.dtype, device=like.device)
    except (TypeError, ValueError, RuntimeError):
        raise ArgumentError(f"{name}: expected numbers, got {value!r:.80}") from None
    if tensor.ndim and not tensor.shape[-1]:
        raise ShapeError(f"{name}: expected numbers, got none: shape {tuple(tensor.shape)}")
    if not holds(tensor.isfinite()):
        raise ArgumentError(f"{name}: expected finite numbers, got {tensor.tolist()!s:.200}")
    return tensor


def checked_angle(
    max_angle: float | Float[Tensor, " ..."], like: Float[Tensor, " ..."]
) -> Float[Tensor, "*batch"]:
    """The limit of a field of view as a tensor, in radians from the optical axis."""
    angle = checked_numbers("max_angle", max_angle, like)
    if not (angle.numel() and holds((angle > 0) & (angle <= torch.pi + 1e-6))):
        raise ArgumentError(
            f"max_angle: expected radians from the optical axis in (0, π], got {max_angle}; it is half the field of "
            "view, e.g. math.radians(110) for a lens of 220°"
        )
    return angle


def checked_size(image_size: Sequence[int]) -> tuple[int, int]:
    """(height, width) of an image, as whole numbers above 0."""
    try:
        height, width = (operator.index(side) if not isinstance(side, float) else side for side in image_size)
        if not (1 <= height == int(height) and 1 <= width == int(width)):
            raise ValueError
    except (TypeError, ValueError, OverflowError):
        raise ArgumentError(
            f"image_size: expected (height, width) in whole pixels above 0, got {short_repr(image_size)}"
        ) from None
    if height * width > MAX_PIXELS:
        raise ArgumentError(
            f"image_size: expected {MAX_PIXELS:,} pixels at most (8192 x 16384), got {height} x {width}"
        )
    return int(height), int(width)


def check_poses(names: list[str], poses: Float[Tensor, "*rigs n 4 4"]) -> None:
    """Raise unless there is a rigid transform ``(*b, n, 4, 4)`` for each camera; errors name the camera."""
    if not names:
        raise ArgumentError("cameras: expected at least one camera, got none")
    check_tensor("world_from_camera", poses, f"(*b, {len(names)}, 4, 4)")
    check_floating("world_from_camera", poses)
    if poses.ndim < 3 or tuple(poses.shape[-3:]) != (len(names), 4, 4):
        raise ShapeError(
            f"world_from_camera: expected shape (*b, {len(names)}, 4, 4) for {len(names)} cameras, "
            f"got {tuple(poses.shape)}"
        )
    detached = poses.detach()
    if not has_numbers(detached):
        return
    finite = detached.isfinite().flatten(-2).all(-1).reshape(-1, len(names)).all(0)
    for name, fine in zip(names, finite.tolist(), strict=True):
        if not fine:
            raise ArgumentError(
                f"world_from_camera: the pose of {name} has NaN or infinite numbers; correct it"
            )
    check_rigid("world_from_camera", detached)


def check_rigid(name: str, transforms: Float[Tensor, "*batch 4 4"]) -> None:
    """Raise ``ArgumentError`` unless transforms turn and shift, and do nothing else."""
    check_rotation(name, transforms[..., :3, :3])
    if bool(((transforms[..., 3, :] - transforms.new_tensor([0, 0, 0, 1])).abs() > 1e-3).any()):
        raise ArgumentError(
            f"{name}: expected (0, 0, 0, 1) as last rows, got {transforms[..., 3, :].reshape(-1, 4).tolist()}"
            "; a matrix acts on columns, translations are in the last one"
        )


def check_rotation(name: str, rotation: Float[Tensor, "*batch 3 3"]) -> None:
    """Raise ``ShapeError`` unless these are ``(*, 3, 3)``, ``ArgumentError`` unless they turn and do nothing else."""
    check_tensor(name, rotation, "(3, 3) or (*b, 3, 3)")
    if rotation.ndim < 2 or tuple(rotation.shape[-2:]) != (3, 3):
        raise ShapeError(f"{name}: expected shape (3, 3) or (*b, 3, 3), got {tuple(rotation.shape)}")
    check_floating(name, rotation)
    if not has_numbers(rotation):
        return
    rotation = rotation.detach().double()
    eye = torch.eye(3, dtype=torch.float64, device=rotation.device)
    rigid = ((rotation @ rotation.mT - eye).abs().amax() < 1e-3) and bool(
        (torch.linalg.det(rotation) > 0).all()
    )
    if not rigid:
        raise ArgumentError(
            f"{name}: expected rotations (3 x 3, orthonormal, determinant +1), but these stretch, mirror or hold NaN"
        )
