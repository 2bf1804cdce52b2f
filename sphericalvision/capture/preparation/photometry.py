# SPDX-License-Identifier: Apache-2.0
"""Exposure and vignetting of a rig's cameras from what they see together.

Convention:
    Values are those of images in [0, 1] as they are displayed. A camera shows ``value * light``; ``light`` is a factor
    for each channel that falls off with the angle from the optical axis:
    ``log light = exposure - (c1 a² + c2 a⁴)``, a = angle / ``edge``.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor

from sphericalvision.cameras.base import check_single
from sphericalvision.cameras.conversion.fit import cap
from sphericalvision.cameras.masks import resized_mask
from sphericalvision.cameras.models.equirectangular import EquirectangularCamera
from sphericalvision.cameras.remapping.lookup import pixels_a_radian
from sphericalvision.cameras.rig import CameraRig, check_images_of
from sphericalvision.cameras.sphere_images import sphere_lookups
from sphericalvision.core import ArgumentError
from sphericalvision.geometry.directions import angle_from_axis
from sphericalvision.icosphere import icosphere_vertices

__all__ = [
    "Photometer",
    "PhotometricCalibration",
    "averaged",
    "calibrate_photometry",
    "pixel_angles",
    "reduced_rig",
]

_POINTS = 2000
_DISTANCES = (10.0, 30.0, 100.0)
"""Of the points where cameras are compared, in radii of the rig: those of a table, a room, a hall."""
_DARKEST, _BRIGHTEST = 0.04, 0.97
"""Values beyond are noise, or cut off."""
_FINER = 4
"""Times as fine as images are compared, the border of what a camera sees is looked for."""
_ROUNDS = 8
_HOLD_EXPOSURE, _HOLD_FALLOFF, _HOLD_ALIKE = 1e-3, 1e-3, 0.02
"""Weights, in shares of all equations, of: no change of exposure; no vignetting; the same lens in all cameras."""


class PhotometricCalibration(NamedTuple):
    """By how much each camera of a rig is brighter or darker than the others, and where.

    Attributes:
        exposure: ``(n, c)`` logarithm of each camera's factor on each channel; their mean is about 0.
        falloff: ``(n, 2)`` c1 and c2 of the module's convention; 0 for panoramas, which have no lens.
        edge: ``(n,)`` radians, largest angle from the axis that a camera sees.
        residual: typical size of the remaining differences, of the logarithm of values.
        spread: standard deviation of ``strength``, as far as parts of the sphere contradict each other.

    Examples:
        >>> lens = PhotometricCalibration(torch.zeros(1, 3), torch.tensor([[0.5, 0.0]]), torch.tensor([1.6]), 0.0)
        >>> round(lens.strength, 2)  # at the edge 39 % of the values are lost
        0.39
    """

    exposure: Float[Tensor, "n c"]
    falloff: Float[Tensor, "n 2"]
    edge: Float[Tensor, " n"]
    residual: float
    spread: float = 0.0

    @property
    def strength(self) -> float:
        """Largest deviation of ``light`` from 1 at the axes and edges of the cameras."""
        return float((self._at_ends() - 1).abs().max())

    def differing(self, others: Sequence[PhotometricCalibration]) -> float:
        """Return the standard deviation of ``strength``, from calibrations without one part of the sphere each."""
        if len(others) < 2:
            return 0.0
        at = int((self._at_ends() - 1).abs().argmax())
        found = torch.stack([other._at_ends().flatten()[at] for other in others])
        return float(((len(found) - 1) * (found - found.mean()).square().mean()).sqrt())  # the jackknife

    def _at_ends(self) -> Tensor:
        return self.light(torch.stack((torch.zeros_like(self.edge), self.edge), -1))

    def light(self, angles: Float[Tensor, " n *points"]) -> Float[Tensor, "n c *points"]:
        """Factors ``(n, c, *points)`` on what cameras show at ``angles`` ``(n, *points)`` from their axes, radians.

        Examples:
            >>> found = PhotometricCalibration(torch.zeros(1, 3), torch.tensor([[0.5, 0.0]]), torch.tensor([1.6]), 0.0)
            >>> found.light(torch.tensor([[0.0, 1.6]]))[0, 0]
            tensor([1.0000, 0.6065])
        """
        count = angles.ndim - 1
        first, second, edge = (
            values.reshape(-1, *[1] * count) for values in (*self.falloff.unbind(-1), self.edge)
        )
        squared = (angles / edge).clamp(max=1).square()
        lost = first * squared + second * squared.square()
        exposure = self.exposure.reshape(*self.exposure.shape, *[1] * count)
        return (exposure - lost.unsqueeze(1)).exp()

    def corrected(
        self, rig: CameraRig, images: Mapping[str, Float[Tensor, "*batch c _ _"]]
    ) -> dict[str, Float[Tensor, "*batch c _ _"]]:
        """Return the images that cameras of the same exposure would take through lenses without vignetting.

        Args:
            rig: of the calibration.
            images: camera name -> ``(*b, c, h, w)`` in [0, 1].

        Examples:
            >>> from sphericalvision.cameras import ring_rig
            >>> rig = ring_rig(2, image_size=(32, 32))
            >>> images = {"cam1": torch.full((3, 32, 32), 0.5), "cam2": torch.full((3, 32, 32), 0.4)}
            >>> even = calibrate_photometry(rig, images).corrected(rig, images)
            >>> [round(image.mean().item(), 2) for image in even.values()]
            [0.45, 0.45]
        """
        return self.divided_out(images, pixel_angles(rig))

    def divided_out(
        self, images: Mapping[str, Float[Tensor, "*batch c _ _"]], angles: Mapping[str, Float[Tensor, "_ _"]]
    ) -> dict[str, Float[Tensor, "*batch c _ _"]]:
        """Return what ``corrected`` does, of the ``pixel_angles`` of the rig."""
        even = {}
        for place, (name, angle) in enumerate(angles.items()):
            here = slice(place, place + 1)
            one = self._replace(
                exposure=self.exposure[here], falloff=self.falloff[here], edge=self.edge[here]
            )
            even[name] = (images[name] / one.light(angle[None])[0].to(images[name])).clamp(0, 1)
        return even


def pixel_angles(rig: CameraRig) -> dict[str, Float[Tensor, "_ _"]]:
    """Return camera name -> angle ``(h, w)`` of each pixel from the optical axis, radians; pi where there is no ray."""
    rays = {name: camera.unproject(camera.pixel_grid()).directions for name, camera in rig.cameras.items()}
    return {name: angle_from_axis(directions).nan_to_num(math.pi) for name, directions in rays.items()}


def calibrate_photometry(
    rig: CameraRig, images: Mapping[str, Float[Tensor, "*batch c _ _"]], depth: float | None = None
) -> PhotometricCalibration:
    """Estimate exposure and vignetting of each camera from images taken at the same time; one frame is enough.

    Two cameras that see the same point should show the same value. The difference of the logarithms of their values is
    linear in the unknowns, which robust linear least squares finds. Points much nearer or farther than ``depth`` do not
    correspond and become outliers. The lenses are assumed to be similar. Cameras that share no view are left as they
    are.

    Args:
        rig: a single rig.
        images: camera name -> ``(*b, c, h, w)`` in [0, 1], as they are displayed; a batch of frames counts as one.
        depth: metres, from the rig's centre to where cameras are compared; when not given, that of 10, 30 and 100 radii
            of the rig at which they agree best.

    Raises:
        ArgumentError: images are not those of the rig's cameras, or ``depth`` is not positive.
        ShapeError: an image has another size than its camera.

    References:
        Goldman (2010), "Vignette and exposure calibration and compensation"; Holland, Welsch (1977), "Robust
        regression using iteratively reweighted least-squares", for the weights (Cauchy's).

    Examples:
        >>> from sphericalvision.cameras import ring_rig
        >>> from sphericalvision.scenes.disturbances import vignetted
        >>> rig = ring_rig(4, image_size=(64, 64))
        >>> grey = torch.full((3, 64, 64), 0.5)
        >>> images = {name: vignetted(grey, camera, loss=0.5) for name, camera in rig.cameras.items()}
        >>> found = calibrate_photometry(rig, images)
        >>> shown = found.light(found.edge[:, None])[:, 0, 0]  # at the edge: half of the light, on a display
        >>> [round(share.item(), 2) for share in shown], round(0.5 ** (1 / 2.2), 2)
        ([0.73, 0.73, 0.73, 0.73], 0.73)
    """
    return Photometer(rig, depth)(images)


class Photometer:
    """``calibrate_photometry`` of one rig, as often as wanted: what follows from the rig is computed once.

    Args:
        rig: a single rig.
        depth: as of ``calibrate_photometry``.

    Raises:
        ArgumentError: ``depth`` is not positive.
    """

    def __init__(self, rig: CameraRig, depth: float | None = None) -> None:
        check_single(rig)
        if depth is not None and not depth > 0:
            raise ArgumentError(f"depth: expected metres above 0, got {depth!r}")
        self.rig = rig
        self._small = reduced_rig(rig, math.sqrt(4 * math.pi / _POINTS))
        finer = {
            name: [
                min(_FINER * length, full)
                for length, full in zip(small.image_size, camera.image_size, strict=True)
            ]
            for (name, camera), small in zip(rig.cameras.items(), self._small.cameras.values(), strict=True)
        }
        fine = rig.resized(finer)
        self._inside, edges = {}, []
        for name, camera in fine.cameras.items():
            directions, inside = camera.unproject(camera.pixel_grid())
            edges.append(angle_from_axis(directions).where(inside, 0.0).amax())
            self._inside[name] = resized_mask(inside, self._small.cameras[name].image_size)
        self._edge = torch.stack(edges)
        radius = float(rig.radius)
        distances = [far * radius for far in _DISTANCES] if depth is None else [depth]
        self._places = [_Points(self, 1 / far if far > 0 else 0.0) for far in distances]

    def __call__(self, images: Mapping[str, Float[Tensor, "*batch c _ _"]]) -> PhotometricCalibration:
        """Estimate exposure and vignetting.

        Args:
            images: as of ``calibrate_photometry``; so are the errors.
        """
        check_images_of(self.rig, images)
        small = averaged(self._small, images)
        frames = [
            small[name].reshape(-1, *small[name].shape[-3:]) * inside for name, inside in self._inside.items()
        ]
        found = [points.compared(frames) for points in self._places]
        best = min(found, key=lambda answer: answer.residual)
        calibration, *others = (
            PhotometricCalibration(exposure.to(self._edge), falloff.to(self._edge), self._edge, best.residual)
            for exposure, falloff in best.answers
        )
        return calibration._replace(spread=calibration.differing(others))


class _Points:
    """Where points at one inverse depth, 1/m, fall in the images, and how much light is lost there."""

    def __init__(self, of: Photometer, inverse_depth: float) -> None:
        rig = of._small
        directions = cap(math.pi, _POINTS, next(iter(rig.cameras.values()))).to(rig.world_from_camera)
        self.lookups = sphere_lookups(rig, directions, inverse_depth=inverse_depth)
        rays = directions + inverse_depth * (rig.center - rig.positions)[:, None].to(directions)
        angles = angle_from_axis(rays @ rig.world_from_camera[:, :3, :3])
        has_lens = [not isinstance(camera, EquirectangularCamera) for camera in rig.cameras.values()]
        squared = (angles / of._edge[:, None]).clamp(max=1).square()
        squared = squared * torch.tensor(has_lens, device=squared.device)[:, None]
        self.basis = torch.stack((squared, squared.square()), -1)
        self.parts = (directions @ icosphere_vertices(0).to(directions).mT).argmax(-1)
        self.shares = [
            look(inside[None].float(), 0)
            for look, inside in zip(self.lookups, of._inside.values(), strict=True)
        ]

    def compared(self, images: list[Tensor]) -> _Solution:
        """Exposure and falloff that explain images ``(b, c, h, w)``, a camera each."""
        values: list[Tensor] = []  # logarithms (c, b V)
        usable: list[Tensor] = []  # whether they are seen, and not at the border of the view (b V,)
        for look, share, frames in zip(self.lookups, self.shares, images, strict=True):
            found = look(frames, 0) / share.to(frames).clamp(min=0.5)
            good = (share[0] > 0.99) & (found.amin(1) > _DARKEST) & (found.amax(1) < _BRIGHTEST)
            values.append(found.clamp(min=_DARKEST).log().movedim(1, 0).flatten(1))
            usable.append(good.flatten())
        return _solve(torch.stack(values), torch.stack(usable), self.basis, self.parts)


class _Solution(NamedTuple):
    """Exposure ``(n, c)`` and falloff ``(n, 2)``, of all points and then without each part of the sphere in turn."""

    answers: list[tuple[Tensor, Tensor]]
    residual: float


def _solve(
    values: Float[Tensor, "n c m"],
    usable: Bool[Tensor, "n m"],
    basis: Float[Tensor, "n V 2"],
    parts: Int[Tensor, " V"],
) -> _Solution:
    """Weighted least squares, weighted anew each round; without a part with the weights that all points ended with."""
    number, channels, count = values.shape
    basis = basis.repeat(1, count // basis.shape[1], 1).double()
    size = number * channels + 2 * number
    rows, differences, places = [], [], []
    for one in range(number):
        for other in range(one):
            both = (usable[one] & usable[other]).nonzero()[:, 0]
            for channel in range(channels):
                row = basis.new_zeros(len(both), size)
                for camera, sign in ((one, 1.0), (other, -1.0)):
                    row[:, camera * channels + channel] = sign
                    first = number * channels + 2 * camera
                    row[:, first : first + 2] = -sign * basis[camera, both]
                rows.append(row)
                places.append(parts[both % len(parts)])
                differences.append((values[one, channel, both] - values[other, channel, both]).double())
    if not rows or not sum(map(len, rows)):
        return _Solution([(values.new_zeros(number, channels), values.new_zeros(number, 2))], 0.0)
    matrix, difference = torch.cat(rows), torch.cat(differences)
    hold = _held(number, channels, basis).mul(len(matrix) / size)
    found, scale = basis.new_zeros(size), 0.3
    for _ in range(_ROUNDS):
        relative = (difference - matrix @ found) / scale
        weights = 1 / (1 + relative.square())
        normal = matrix.mT @ (weights[:, None] * matrix) + hold * weights.mean()
        found = torch.linalg.solve(normal, matrix.mT @ (weights * difference))
        scale = max(0.01, 1.4826 * float((difference - matrix @ found).abs().median()))
    place = torch.cat(places)
    answers = [found]
    for part in place.unique():  # as good as independent, which neighbouring points are not
        here, share = matrix[place == part], weights[place == part]
        without = normal - here.mT @ (share[:, None] * here)
        wanted = matrix.mT @ (weights * difference) - here.mT @ (share * difference[place == part])
        answers.append(torch.linalg.solve(without, wanted))
    split = (answer.split((number * channels, 2 * number)) for answer in answers)
    return _Solution([(one.view(number, channels), two.view(number, 2)) for one, two in split], scale)


def _held(number: int, channels: int, like: Tensor) -> Tensor:
    """The regularisation, as a quadratic form: it decides where the images do not."""
    size = number * channels
    hold = torch.zeros(size + 2 * number, size + 2 * number, dtype=like.dtype, device=like.device)
    hold.diagonal()[:size] = _HOLD_EXPOSURE
    hold.diagonal()[size:] = _HOLD_FALLOFF
    alike = torch.eye(number, dtype=like.dtype, device=like.device) - 1 / number
    for term in range(2):
        hold[size + term :: 2, size + term :: 2] += _HOLD_ALIKE * alike
    return hold


def reduced_rig(rig: CameraRig, pixel: float) -> CameraRig:
    """Return the rig of images whose pixels are not finer than ``pixel``, in radians at the optical axis.

    Examples:
        >>> from sphericalvision.cameras import ring_rig
        >>> reduced_rig(ring_rig(3, image_size=(768, 800)), 0.02).cameras["cam1"].image_size
        (192, 200)
    """
    sizes = {}
    for name, camera in rig.cameras.items():
        shrink = max(1, int(pixel * pixels_a_radian(camera)))
        sizes[name] = tuple(max(1, round(length / shrink)) for length in camera.image_size)
    return rig.resized(sizes)


def averaged(
    rig: CameraRig, images: Mapping[str, Float[Tensor, "*batch c _ _"]]
) -> dict[str, Float[Tensor, "*batch c _ _"]]:
    """Return whole images averaged to the sizes of a rig's cameras; those that have them are handed on."""
    small = {}
    for name, camera in rig.cameras.items():
        image = images[name]
        if tuple(image.shape[-2:]) != camera.image_size:
            flat = F.interpolate(image.reshape(-1, *image.shape[-3:]), camera.image_size, mode="area")
            image = flat.reshape(*image.shape[:-2], *camera.image_size)
        small[name] = image
    return small
