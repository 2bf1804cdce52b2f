# SPDX-License-Identifier: Apache-2.0
"""The contract of every camera: points to pixels and pixels to directions, each with a validity mask."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar, NamedTuple, TypeVar

import torch
from jaxtyping import Bool, Float, Shaped
from torch import Tensor

from sphericalvision.cameras.checks import (
    at_least_float32,
    check_image,
    check_precision,
    checked_angle,
    checked_size,
)
from sphericalvision.cameras.declaration import DeclaredModel
from sphericalvision.core import ArgumentError, ArgumentTypeError, ShapeError, check_last_dim, check_tensor
from sphericalvision.geometry.bilinear import bilinear_sample
from sphericalvision.geometry.directions import components, moderate_lengths

AnyCamera = TypeVar("AnyCamera", bound="Camera")


class Projection(NamedTuple):
    """Pixels and whether the camera sees them.

    Examples:
        >>> from sphericalvision.cameras import FisheyeCamera
        >>> camera = FisheyeCamera.from_field_of_view((64, 64), 3.5)
        >>> pixels, valid = camera.project(torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]]))
        >>> valid.tolist()
        [True, False]
    """

    pixels: Float[Tensor, "*batch 2"]
    """(u, v), shape (*, 2), also where not valid."""
    valid: Bool[Tensor, "*batch"]
    """bool (*)."""


class Unprojection(NamedTuple):
    """Directions and whether the camera looks there.

    Examples:
        >>> from sphericalvision.cameras import FisheyeCamera
        >>> camera = FisheyeCamera.from_field_of_view((64, 64), 3.5)
        >>> directions, valid = camera.unproject(torch.tensor([[31.5, 31.5], [0.0, 0.0]]))
        >>> directions[0].abs().round().tolist(), valid.tolist()
        ([0.0, 0.0, 1.0], [True, False])
    """

    directions: Float[Tensor, "*batch 3"]
    """Unit vectors (*, 3), also where not valid."""
    valid: Bool[Tensor, "*batch"]
    """bool (*)."""


class Camera(DeclaredModel):
    """A central camera. It maps points or directions, not the plane z = 1, so fields of view beyond 180° are possible.

    Intrinsics are tensors whose batch dimensions ``*b`` broadcast with each other (none for a single camera); points
    and pixels given to a batched camera start with the same dimensions. Intrinsics take the dtype and device of the
    points or pixels, so one camera works in float32 and float64, and gradients reach them. Points and pixels in half
    precision are computed and returned in float32.

    Convention:
        x right, y down, z forward along the optical axis. Pixels are (u, v) = (column, row) with integer pixel centres;
        the image covers [−0.5, w − 0.5] x [−0.5, h − 0.5]. ``max_angle`` is measured from the optical axis in radians:
        half the field of view.

    A model is a subclass that declares its intrinsics and names its two pure ``functions``, which need not consider the
    image borders and ``max_angle``. Its constructor takes what is declared, in that order; ``image_size`` is (height,
    width), and ``max_angle`` is by default where the model ends. A model may also write its own ``__init__``,
    ``_project`` and ``_unproject``. ``register_camera`` makes it known to the readers and writers of files.

    Examples:
        >>> from sphericalvision.cameras import FisheyeCamera
        >>> camera = FisheyeCamera.from_field_of_view((64, 64), 3.5)
        >>> directions, valid = camera.unproject(torch.tensor([[40.0, 20.0]]))
        >>> camera.project(2.0 * directions).pixels.round(decimals=3)
        tensor([[40., 20.]])
    """

    model: ClassVar[str]
    """Name of the model in files."""
    is_endless: ClassVar[bool] = False
    """Whether the model goes up to straight back, so that files leave the end of the view to the image."""
    functions: ClassVar[tuple[Callable[..., Projection], Callable[..., Unprojection]]]
    """The model's pure functions of projection and unprojection; after the points or pixels they take the intrinsics,
    but for a skew, and then the options."""

    @property
    def batch_shape(self) -> tuple[int, ...]:
        """The leading dimensions ``*b`` of the intrinsics."""
        return tuple(self.max_angle.shape)

    @property
    def device(self) -> torch.device:
        """Where the intrinsics are."""
        return self.max_angle.device

    @property
    def dtype(self) -> torch.dtype:
        """The intrinsics' floating point type."""
        return self.max_angle.dtype

    @property
    def edges(self) -> str:
        """How images go on beyond their edges, see ``image_lookup``: ``"border"``, not at all, but for panoramas."""
        return "border"

    def _project(self, points: Tensor) -> Projection:
        """The model's pixels, valid where the model itself is defined."""
        return self.functions[0](points, *self._arguments(points))

    def _unproject(self, pixels: Tensor) -> Unprojection:
        """The model's unit directions, valid where the model itself is defined."""
        return self.functions[1](pixels, *self._arguments(pixels))

    def _arguments(self, values: Tensor) -> list[Any]:
        """What the model's functions take after ``values``."""
        tensors = dict(zip(self.intrinsic_names, self._aligned(values), strict=True))
        tensors.pop("skew", None)
        return [*tensors.values(), *(getattr(self, name) for name in self.option_names)]

    def project(self, points: Float[Tensor, "*points 3"]) -> Projection:
        """Pixels (*, 2) of ``points`` (*, 3) in the camera's frame, of any length.

        Valid means: neither the camera centre nor at infinity, within ``max_angle``, where the model is defined, and
        inside the image.

        Raises:
            ShapeError: ``points`` is not (*, 3), or does not start with the camera's batch dimensions.
        """
        check_last_dim("points", points, 3)
        points = at_least_float32("points", points)
        points = torch.stack(points.unbind(-1)).movedim(0, -1)  # with contiguous components
        points = moderate_lengths(points)
        pixels, valid = self._project(points)
        return Projection(pixels, valid & self._within_max_angle(points) & self.contains(pixels))

    def unproject(self, pixels: Float[Tensor, "*pixels 2"]) -> Unprojection:
        """Unit directions (*, 3) in the camera's frame of ``pixels`` (*, 2), given as (u, v).

        Valid means: inside the image, where the model is defined, and within ``max_angle``.

        Raises:
            ShapeError: ``pixels`` is not (*, 2), or does not start with the camera's batch dimensions.
        """
        check_last_dim("pixels", pixels, 2)
        pixels = at_least_float32("pixels", pixels)
        directions, valid = self._unproject(pixels)
        return Unprojection(
            directions, valid & self._looks_within_max_angle(directions) & self.contains(pixels)
        )

    def contains(self, pixels: Float[Tensor, "*pixels 2"]) -> Bool[Tensor, " ..."]:
        """Whether ``pixels`` (*, 2) lie on the image, half a pixel around the outermost centres included, (*)."""
        check_last_dim("pixels", pixels, 2)
        height, width = self.image_size
        u, v = pixels.detach().unbind(-1)
        from_middle_u, from_middle_v = (u - (width - 1) / 2).abs(), (v - (height - 1) / 2).abs()
        return (from_middle_u <= width / 2) & (from_middle_v <= height / 2)

    def sample(
        self, image: Shaped[Tensor, "*images c h w"], points: Float[Tensor, "*points n 3"]
    ) -> tuple[Float[Tensor, "*batch c n"], Bool[Tensor, "*seen n"]]:
        """Values (*b, c, n) of ``image`` (*b, c, h, w) where ``points`` (*b, n, 3) appear, and validity (*b, n).

        Bilinear; 0 where not valid.

        Raises:
            ShapeError: the image is not of the camera's size.
            ArgumentError: the image is no tensor.
        """
        check_image("image", image, self.image_size)
        pixels, valid = self.project(points)
        pixels = torch.where(valid.unsqueeze(-1), pixels, 0.0)
        values = self.interpolate(image, pixels)
        return torch.where(valid.unsqueeze(-2), values, 0.0), valid

    def interpolate(
        self, image: Shaped[Tensor, "*images c h w"], pixels: Float[Tensor, "*pixels n 2"]
    ) -> Float[Tensor, "*batch c n"]:
        """Values (*b, c, n) of ``image`` (*b, c, h, w) at ``pixels`` (*b, n, 2), bilinear; a panorama's seam is closed.

        The image may have another size than the camera's, for instance that of a feature map; the pixels are its own.
        """
        return bilinear_sample(image, pixels)

    def pixel_grid(self, dtype: torch.dtype | None = None) -> Float[Tensor, "h w 2"]:
        """All pixel centres (h, w, 2) as (u, v), in float32 or more: half precision has no whole numbers that large."""
        height, width = self.image_size
        dtype = torch.promote_types(dtype or self.dtype, torch.float32)
        v = torch.arange(height, dtype=dtype, device=self.device)
        u = torch.arange(width, dtype=dtype, device=self.device)
        return torch.stack(torch.meshgrid(u, v, indexing="xy"), dim=-1)

    def to(self: AnyCamera, *args: Any, **kwargs: Any) -> AnyCamera:
        """The same camera with its tensors moved or converted, as ``torch.Tensor.to``.

        Raises:
            ArgumentError: to half precision, which cannot hold intrinsics.
        """
        moved = self._map(lambda tensor: tensor.to(*args, **kwargs))
        check_precision(moved.dtype)
        return moved

    def with_intrinsics(
        self: AnyCamera, values: Mapping[str, Tensor] | None = None, /, **named: Tensor
    ) -> AnyCamera:
        """The same camera with other tensors for some of its intrinsics or ``max_angle``, taken as they are.

        Their shapes must be those that they replace, but for batch dimensions that all have. Gradients reach them, and
        transforms of ``torch.func`` see them.

        Args:
            values: by name, or as ``named``.
            **named: such as ``focal_length=...``.

        Raises:
            ArgumentError: the camera has no such intrinsic, or what is given is no tensor.

        Examples:
            >>> from sphericalvision.cameras import PinholeCamera
            >>> camera = PinholeCamera([500.0, 500.0], [319.5, 239.5], (480, 640))
            >>> pixel = lambda f: camera.with_intrinsics(focal_length=f).project(torch.tensor([0.1, 0.0, 1.0])).pixels
            >>> torch.func.jacrev(pixel)(camera.focal_length)  # of u and v, with respect to both focal lengths
            tensor([[0.1000, 0.0000],
                    [0.0000, 0.0000]])
        """
        values = {**(values or {}), **named}
        unknown = set(values) - set(self._tensor_names())
        if unknown:
            raise ArgumentError(
                f"intrinsics: this camera has {', '.join(self._tensor_names())}, not {', '.join(sorted(unknown))}"
            )
        changed = copy.copy(self)
        for name, value in values.items():
            check_tensor(name, value, str(tuple(getattr(self, name).shape)))
            setattr(changed, name, value)
        return changed

    def with_max_angle(self: AnyCamera, max_angle: float | Float[Tensor, "*#batch"]) -> AnyCamera:
        """The same camera with another limit of its field of view, in radians from the optical axis."""
        changed = copy.copy(self)
        changed.max_angle = checked_angle(max_angle, self.max_angle).expand(self.batch_shape)
        return changed

    def resized(self: AnyCamera, image_size: Sequence[int]) -> AnyCamera:
        """The camera of the same images after they are resized to ``image_size`` (height, width).

        The image's edges stay edges, so a pixel (u, v) moves to ((u + 0.5) s − 0.5, (v + 0.5) t − 0.5) with s and t
        the ratios of the widths and heights; its ray stays the same.

        Raises:
            ArgumentError: ``image_size`` is not two positive whole numbers.

        Examples:
            >>> from sphericalvision.cameras import PinholeCamera
            >>> PinholeCamera([500.0, 500.0], [319.5, 239.5], (480, 640)).resized((240, 320)).principal_point
            tensor([159.5000, 119.5000])
        """
        new = checked_size(image_size)
        s, t = new[1] / self.image_size[1], new[0] / self.image_size[0]
        return self._on_pixels((s, t), (s / 2 - 0.5, t / 2 - 0.5), new)

    def cropped(self: AnyCamera, top: int, left: int, height: int, width: int) -> AnyCamera:
        """The camera of ``image[..., top : top + height, left : left + width]``; the rays stay the same.

        Raises:
            ArgumentError: the rectangle is empty or reaches out of the image.

        Examples:
            >>> from sphericalvision.cameras import PinholeCamera
            >>> PinholeCamera([500.0, 500.0], [319.5, 239.5], (480, 640)).cropped(40, 120, 400, 400).principal_point
            tensor([199.5000, 199.5000])
        """
        new = checked_size((height, width))
        if not (isinstance(top, int) and isinstance(left, int)):
            raise ArgumentTypeError(
                f"cropped: expected whole pixels for top and left, got {top!r} and {left!r}"
            )
        if not (0 <= top <= self.image_size[0] - new[0] and 0 <= left <= self.image_size[1] - new[1]):
            raise ArgumentError(
                f"cropped: expected a rectangle inside of the image of {self.image_size[0]} x {self.image_size[1]} "
                f"(height x width), got rows {top} to {top + height} and columns {left} to {left + width}"
            )
        return self._on_pixels((1.0, 1.0), (-float(left), -float(top)), new)

    def select(self: AnyCamera, index: int) -> AnyCamera:
        """One camera of a batch."""
        if not self.batch_shape or not -self.batch_shape[0] <= index < self.batch_shape[0]:
            raise ArgumentError(f"index: expected one of a batch of shape {self.batch_shape}, got {index!r}")
        return self._map(lambda tensor: tensor[index])

    @classmethod
    def stack(cls: type[AnyCamera], cameras: Sequence[AnyCamera]) -> AnyCamera:
        """A batch of cameras of one model, image size and number of parameters.

        Raises:
            ArgumentError: the cameras differ in more than the values of their intrinsics.
        """
        if not cameras:
            raise ArgumentError("cameras: expected at least one camera, got none")
        first = cameras[0]
        for other in cameras[1:]:
            if other._signature() != first._signature():
                raise ArgumentError(
                    "cameras: a batch needs one model, image size and number of parameters; got "
                    f"{first!r} and {other!r}"
                )
        stacked = copy.copy(first)
        for name in first._tensor_names():
            setattr(stacked, name, torch.stack([getattr(camera, name) for camera in cameras]))
        return stacked

    def equals(self, other: Camera) -> bool:
        """Whether the other camera has the same model, image size and values."""
        return self._signature() == other._signature() and all(
            torch.equal(getattr(self, name), getattr(other, name)) for name in self._tensor_names()
        )

    def __repr__(self) -> str:
        degrees = (2 * torch.rad2deg(self.max_angle.detach().double())).flatten()[:1].item()
        batch = f", batch_shape={self.batch_shape}" if self.batch_shape else ""
        return f"{type(self).__name__}(image_size={self.image_size}, field of view {degrees:.1f}°{batch})"

    # What subclasses use -------------------------------------------------------------------------------------------

    def _on_pixels(
        self: AnyCamera, scale: tuple[float, float], offset: tuple[float, float], image_size: tuple[int, int]
    ) -> AnyCamera:
        """The camera whose pixels are ``scale * pixels + offset``; here for models with a principal point."""
        scaled, center = self._scaled(scale), vars(self).get("principal_point")
        if not scaled or center is None:
            raise ArgumentError(
                f"resized, cropped: {type(self).__name__} has no focal length and principal point; its class must "
                "override _on_pixels"
            )
        changed = copy.copy(self)
        center = center * center.new_tensor(scale) + center.new_tensor(offset)
        vars(changed).update(scaled, principal_point=center, image_size=image_size)
        return changed

    def _scaled(self, scale: tuple[float, float]) -> dict[str, Tensor]:
        """The intrinsics that lengths in pixels change, for pixels ``scale`` times as large; none if not known."""
        values = vars(self)
        scaled = {}
        if "focal_length" in values:
            scaled["focal_length"] = values["focal_length"] * self.max_angle.new_tensor(scale)
        if values.get("skew") is not None:
            scaled["skew"] = values["skew"] * scale[0]
        return scaled

    def _aligned(self, values: Tensor) -> list[Any]:
        """Intrinsics shaped to broadcast with ``values`` (*b, *, k), in its dtype and on its device, or ``None``."""
        tensors = [getattr(self, name) for name in self.intrinsic_names]
        return [None if tensor is None else self._align(tensor, values) for tensor in tensors]

    def _align(self, tensor: Tensor, values: Tensor) -> Tensor:
        batch = self.batch_shape
        lead = values.shape[: min(len(batch), values.ndim - 1)]
        if len(lead) == len(batch) and any(
            a not in (b, 1) and b != 1 for a, b in zip(lead, batch, strict=True)
        ):
            raise ShapeError(
                f"points or pixels: a camera of batch shape {batch} expects ({', '.join(map(str, batch))}, *, "
                f"{values.shape[-1]}), got {tuple(values.shape)}"
            )
        ones = (1,) * max(values.ndim - 1 - len(batch), 0)
        return tensor.to(values).reshape((*batch, *ones, *tensor.shape[len(batch) :]))

    def _widest(self, values: Tensor) -> Tensor:
        """``max_angle`` to compare with, slackened so that a round trip does not lose the very edge."""
        return self._align(self.max_angle, values) + 32 * torch.finfo(values.dtype).eps

    def _within_max_angle(self, points: Tensor) -> Tensor:
        """Whether points of any length are within ``max_angle`` of the axis, and not the camera's centre.

        z |z| / (x² + y²) falls as the angle grows: squares decide, and no arc tangent is needed. The backward axis is
        within no angle.
        """
        eps = torch.finfo(points.dtype).eps
        cotangent = 1 / torch.tan(self._widest(points).clamp_max(math.pi - 1.5 * eps))
        x, y, z = components(points.detach())
        squared = torch.addcmul(x * x, y, y)
        return torch.addcmul(z * z.abs(), squared, cotangent * cotangent.abs(), value=-1) > 0

    def _looks_within_max_angle(self, directions: Tensor) -> Tensor:
        """The same for unit directions."""
        lowest = torch.cos(self._widest(directions).clamp_max(math.pi))
        return directions[..., 2] >= lowest - 4 * torch.finfo(directions.dtype).eps

    def _signature(self) -> tuple[Any, ...]:
        shapes = tuple((name, tuple(getattr(self, name).shape)) for name in self._tensor_names())
        return (type(self), self.image_size, shapes, *(getattr(self, name) for name in self.option_names))

    def _map(self: AnyCamera, function: Callable[[Tensor], Tensor]) -> AnyCamera:
        mapped = copy.copy(self)
        for name in self._tensor_names():
            setattr(mapped, name, function(getattr(self, name)))
        return mapped


def check_single(thing: Any) -> None:
    """Raise ``ArgumentError`` for a batch of cameras or rigs, or what is neither."""
    if not hasattr(thing, "batch_shape"):
        raise ArgumentTypeError(f"expected a camera or a rig, got {type(thing).__name__}")
    if thing.batch_shape:
        name = "camera" if isinstance(thing, Camera) else "rig"
        raise ArgumentError(
            f"{name}: expected a single {name}, got a batch {thing.batch_shape}; take one with {name}.select(i)"
        )
