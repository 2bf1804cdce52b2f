# SPDX-License-Identifier: Apache-2.0
"""What real cameras on a real rig do to a frame: light, lens, sensor, and poses that are a little wrong."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from sphericalvision.cameras import Camera, CameraRig
from sphericalvision.core import ArgumentError, check_choice
from sphericalvision.extensions import Registry
from sphericalvision.geometry import angle_from_axis, transform_from_axis_angle

Sample = dict[str, Any]

DISPLAY = 2.2
"""Exponent of the display curve: a picture's value is light to the power of its inverse."""

GREY = (0.299, 0.587, 0.114)

AMOUNTS = ("vignetting", "blur", "exposure", "white_balance", "noise", "pose_error_deg")
"""Faults of ``CameraDisturbance`` that have an amount, in the order in which they are drawn."""

Disturb = Callable[[Tensor, Camera, float, torch.Generator | None], Tensor]
"""From an image ``(3, h, w)`` in [0, 1], its camera, an amount above 0, and a source of randomness to the image that is
disturbed by that much."""

DISTURBANCES: Registry[Disturb] = Registry(
    "disturbance",
    "a function that disturbs an image, and no name of a fault that there is,",
    lambda name, thing: bool(name) and name not in ("disturbed", "grey", *AMOUNTS) and callable(thing),
    "sphericalvision.disturbances",
)
"""Disturbances of one's own, by name."""


def register_disturbance(name: str) -> Callable[[Disturb], Disturb]:
    """Make a function of an image, its camera, an amount and a generator known as a fault of cameras.

    It comes after all others, so that these are for each seed what they are without it. A package that others install
    names its own as entry points of the group ``sphericalvision.disturbances``.

    Args:
        name: with which ``CameraDisturbance``, ``RandomFaults``, ``data.world.faults`` in a training and
            the tracks of ``sphericalvision-benchmark`` know it.

    Raises:
        ArgumentError: another disturbance has the name already.

    Examples:
        >>> from sphericalvision.cameras import ring_rig
        >>> @register_disturbance("haze")
        ... def hazy(image, camera, amount, generator=None):
        ...     return image + amount * (0.8 - image)
        >>> lens = ring_rig(2, image_size=(8, 8)).cameras["cam1"]
        >>> CameraDisturbance(others={"haze": 1.0}).image(torch.zeros(3, 8, 8), lens).mean() >= 0.4
        tensor(True)
    """

    def register(disturb: Disturb) -> Disturb:
        DISTURBANCES.add(name, disturb)
        return disturb

    return register


@dataclass(frozen=True)
class CameraDisturbance:
    """Disturb a frame, each camera by its own draw; what a method is told of the rig stays free of the change.

    Belongs before ``ToSphere``, where images are still those of the cameras. Amounts are drawn for each camera from
    half of what is given to all of it, but for the pose error, which has exactly the angle given, about an axis drawn
    at random. The order is that of light: lens, exposure, sensor; those of one's own come last.

    Args:
        grey: whether all cameras take pictures without colour.
        vignetting: light lost at the edge of the field of view, 0 to 1; it grows with the square of the angle.
        blur: standard deviation of a Gaussian in pixels.
        exposure: factor on the light in stops, upwards or downwards: one stop is a factor of two.
        white_balance: the same for each colour channel on its own.
        noise: standard deviation of Gaussian noise, of the range [0, 1].
        pose_error: radians by which the rig's calibration has each camera turned.
        others: amounts of disturbances of one's own, by the names of ``register_disturbance``.

    Raises:
        ArgumentError: a negative amount, a vignetting above 1, or an unknown name.

    Examples:
        >>> from sphericalvision.cameras import ring_rig
        >>> rig = ring_rig(2, image_size=(8, 8))
        >>> frame = {"images": {name: torch.full((3, 8, 8), 0.5) for name in rig.names}, "rig": rig}
        >>> brighter = CameraDisturbance(exposure=1.0)(frame, torch.Generator().manual_seed(0))
        >>> [round(image.mean().item(), 2) for image in brighter["images"].values()]
        [0.66, 0.65]
    """

    grey: bool = False
    vignetting: float = 0.0
    blur: float = 0.0
    exposure: float = 0.0
    white_balance: float = 0.0
    noise: float = 0.0
    pose_error: float = 0.0
    others: Mapping[str, float] = field(default_factory=dict, hash=False)

    def __post_init__(self) -> None:
        amounts = {each.name: getattr(self, each.name) for each in fields(self) if each.name != "others"}
        for name, amount in {**amounts, **self.others}.items():
            if not amount >= 0:
                raise ArgumentError(f"{name}: expected 0 or more, got {amount!r}")
        for name in self.others:
            _extension(name)
        if self.vignetting > 1:
            raise ArgumentError(
                f"vignetting: expected at most 1, all light at the edge, got {self.vignetting}"
            )

    def __call__(self, sample: Sample, generator: torch.Generator | None = None) -> Sample:
        """Return the sample with other ``images`` (camera name -> ``(3, h, w)`` in [0, 1]) and another ``rig``.

        Args:
            sample: a frame before ``ToSphere``.
            generator: source of randomness; torch's global one when not given.
        """
        if isinstance(sample["images"], Tensor):
            raise ArgumentError(
                "CameraDisturbance: expected images by camera name; it belongs before ToSphere"
            )
        rig: CameraRig = sample["rig"]
        images = {
            name: self.image(image, rig.cameras[name], generator) for name, image in sample["images"].items()
        }
        if self.pose_error:
            rig = turned_poses(rig, self.pose_error, generator)
        return {**sample, "images": images, "rig": rig}

    def image(
        self, image: Float[Tensor, "3 h w"], camera: Camera, generator: torch.Generator | None = None
    ) -> Float[Tensor, "3 h w"]:
        """Return the picture ``(3, h, w)`` in [0, 1] that a camera with these faults takes in place of ``image``."""

        def amount(most: float) -> float:
            return most * (0.5 + 0.5 * torch.rand((), generator=generator).item())

        def sign() -> float:
            return 1.0 if torch.rand((), generator=generator).item() < 0.5 else -1.0

        if self.vignetting:
            image = vignetted(image, camera, amount(self.vignetting))
        if self.blur:
            from kornia.filters import gaussian_blur2d  # a second to import

            sigma = amount(self.blur)
            size = 2 * math.ceil(3 * sigma) + 1
            image = gaussian_blur2d(image[None], (size, size), (sigma, sigma))[0]
        if self.exposure or self.white_balance:
            stops = torch.full((3, 1, 1), sign() * amount(self.exposure))
            stops += torch.tensor([sign() * amount(self.white_balance) for _ in range(3)]).view(3, 1, 1)
            image = image * (2**stops).to(image) ** (1 / DISPLAY)
        if self.grey:
            image = (image * image.new_tensor(GREY).view(3, 1, 1)).sum(0, keepdim=True).expand(3, -1, -1)
        if self.noise:
            drawn = torch.randn(image.shape, generator=generator)
            image = image + amount(self.noise) * drawn.to(image)
        for name, most in self.others.items():
            image = _extension(name)(image, camera, amount(most), generator)
        return image.clamp(0, 1)


@dataclass(frozen=True)
class RandomFaults:
    """Faults that come now and then: how often, and the largest amount of each, which is drawn from 0.

    Args:
        disturbed: share of seeds that have any; None: all may.
        grey: share of these in which all cameras take pictures without colour.
        amounts: share, and largest amount, of ``vignetting``, ``blur``, ``exposure``, ``white_balance`` and ``noise``,
            as of ``CameraDisturbance``, of ``pose_error_deg`` in degrees, and of any of ``register_disturbance``.

    Raises:
        ArgumentError: a name that is unknown or missing, a share that is not from 0 to 1, or a negative amount.

    Examples:
        >>> never = dict.fromkeys(AMOUNTS, (0.0, 0.0))
        >>> faults = RandomFaults(None, 1.0, {**never, "vignetting": (0.5, 0.6)})
        >>> faults.draw(torch.Generator().manual_seed(0)).grey
        True
    """

    disturbed: float | None
    grey: float
    amounts: Mapping[str, tuple[float, float]]

    def __post_init__(self) -> None:
        if not set(AMOUNTS) <= set(self.amounts):
            raise ArgumentError(f"faults: expected {', '.join(AMOUNTS)}, got {', '.join(self.amounts)}")
        for name in self._others:
            _extension(name)
        probabilities = {
            "disturbed": (1.0 if self.disturbed is None else self.disturbed, 0.0),
            "grey": (self.grey, 0.0),
        }
        for name, (share, most) in {**probabilities, **self.amounts}.items():
            if not 0 <= share <= 1 or not most >= 0:
                raise ArgumentError(
                    f"faults.{name}: expected a share from 0 to 1, and an amount of 0 or more, got {share} and {most}"
                )

    @classmethod
    def of(cls, values: Mapping[str, Any]) -> RandomFaults:
        """Make them of plain values, as a file holds them: the amounts, ``disturbed`` and ``grey``."""
        amounts = dict(values)
        try:
            return cls(amounts.pop("disturbed"), amounts.pop("grey"), amounts)
        except KeyError as error:
            raise ArgumentError(f"faults: expected disturbed, grey and amounts, {error} is missing") from None

    @property
    def _others(self) -> list[str]:
        return [name for name in self.amounts if name not in AMOUNTS]

    def draw(self, generator: torch.Generator | None = None) -> CameraDisturbance:
        """Draw the faults of one seed; from torch's global generator when none is given."""

        def uniform() -> float:
            return torch.rand((), generator=generator).item()

        def sometimes(name: str) -> float:
            share, most = self.amounts[name]
            return most * uniform() if uniform() < share else 0.0

        if self.disturbed is not None and uniform() >= self.disturbed:
            return CameraDisturbance()
        grey = uniform() < self.grey
        amounts = {name: sometimes(name) for name in AMOUNTS}
        amounts["pose_error"] = math.radians(amounts.pop("pose_error_deg"))
        return CameraDisturbance(grey, **amounts, others={name: sometimes(name) for name in self._others})


def _extension(name: str) -> Disturb:
    disturb = DISTURBANCES.find(name)
    if disturb is None:
        check_choice("disturbance", name, (*AMOUNTS, *DISTURBANCES.names()))
    assert disturb is not None
    return disturb


def vignetted(image: Float[Tensor, "3 h w"], camera: Camera, loss: float) -> Float[Tensor, "3 h w"]:
    """Return the picture that a lens takes which loses light towards the edge of its field of view.

    Args:
        image: ``(3, h, w)`` in [0, 1], as on a display.
        camera: whose picture it is.
        loss: share of the light lost at ``camera.max_angle``; that at an angle is in proportion to its square.

    Examples:
        >>> from sphericalvision.cameras import FisheyeCamera
        >>> lens = FisheyeCamera.from_field_of_view((9, 9), math.pi)
        >>> vignetted(torch.ones(3, 9, 9), lens, 0.5)[0, 4, ::4]  # half a pixel from the edge
        tensor([0.7958, 1.0000, 0.7958])
    """
    directions = camera.unproject(camera.pixel_grid()).directions
    angle = angle_from_axis(directions) / camera.max_angle
    light = 1 - loss * angle.nan_to_num(1.0).clamp(0, 1).square()
    return image * (light.clamp(min=0) ** (1 / DISPLAY)).to(image)


def turned_poses(rig: CameraRig, angle: float, generator: torch.Generator | None = None) -> CameraRig:
    """Return the rig with each camera turned where it stands by ``angle`` radians about an axis drawn at random.

    Examples:
        >>> from sphericalvision.cameras import ring_rig
        >>> rig = ring_rig(4)
        >>> off = turned_poses(rig, 0.1)
        >>> torch.allclose(off.positions, rig.positions), torch.equal(off.axes, rig.axes)
        (True, False)
    """
    axes = torch.nn.functional.normalize(torch.randn(len(rig), 3, generator=generator), dim=-1)
    poses = rig.world_from_camera
    rotations = transform_from_axis_angle((angle * axes).to(poses), poses.new_zeros(len(rig), 3))
    return rig.replaced(world_from_camera=poses @ rotations)
