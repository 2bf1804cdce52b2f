# SPDX-License-Identifier: Apache-2.0
"""Exposure and vignetting of a rig's cameras from what they see together.

Convention:
    Values are those of images in [0, 1] as they are displayed. A camera shows ``value * light``; ``light`` is a factor
    for each channel that falls off with the angle from the optical axis:
    ``log light = exposure - (c1 a² + c2 a⁴)``, a = angle / ``edge``.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import NamedTuple, TypeVar

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from sphericalvision.cameras.base import check_single
from sphericalvision.cameras.field_of_view import cap
from sphericalvision.cameras.masks import resized_mask
from sphericalvision.cameras.models.equirectangular import EquirectangularCamera
from sphericalvision.cameras.remapping.lookup import pixels_a_radian
from sphericalvision.cameras.rig import CameraRig, check_images_of
from sphericalvision.core import ArgumentError
from sphericalvision.geometry.directions import angle_from_axis
from sphericalvision.geometry.image_lookup import image_lookup
from sphericalvision.icosphere import icosphere_vertices
from sphericalvision.kernels import Operator

Made = TypeVar("Made")

_POINTS, _PARTS = 2000, 12
"""All around the rig; parts of the sphere, around the corners of an icosahedron."""
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
        return float((_at_ends(self.exposure, self.falloff) - 1).abs().max())

    def light(self, angles: Float[Tensor, " n *points"]) -> Float[Tensor, "n c *points"]:
        """Factors ``(n, c, *points)`` on what cameras show at ``angles`` ``(n, *points)`` from their axes, radians.

        Examples:
            >>> lens = PhotometricCalibration(torch.zeros(1, 3), torch.tensor([[0.5, 0.0]]), torch.tensor([1.6]), 0.0)
            >>> lens.light(torch.tensor([[0.0, 1.6]]))[0, 0]
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
        even = {}
        for place, (name, angle) in enumerate(pixel_angles(rig).items()):
            window = slice(place, place + 1)
            own = self.exposure[window], self.falloff[window], self.edge[window]
            one = PhotometricCalibration(*own, self.residual)
            even[name] = (images[name] / one.light(angle[None])[0].to(images[name])).clamp(0, 1)
        return even


class LightEstimate(NamedTuple):
    """A ``PhotometricCalibration`` whose every number is a tensor, on the device of the images."""

    exposure: Float[Tensor, "n c"]
    falloff: Float[Tensor, "n 2"]
    edge: Float[Tensor, " n"]
    residual: Float[Tensor, ""]
    spread: Float[Tensor, ""]
    strength: Float[Tensor, ""]

    def calibration(self) -> PhotometricCalibration:
        """Return the same with plain numbers, for which a device is waited for."""
        return PhotometricCalibration(*self[:3], float(self.residual), float(self.spread))

    def light(self, angles: Float[Tensor, " n *points"]) -> Float[Tensor, "n c *points"]:
        """Return factors as ``PhotometricCalibration.light`` does."""
        return PhotometricCalibration(self.exposure, self.falloff, self.edge, 0.0).light(angles)


def _at_ends(
    exposure: Float[Tensor, "*b n c"], falloff: Float[Tensor, "*b n 2"]
) -> Float[Tensor, "*b n c 2"]:
    """Factors of light at the axes and at the edges of cameras."""
    return torch.stack((exposure, exposure - falloff.sum(-1, keepdim=True)), -1).exp()


def pixel_angles(rig: CameraRig) -> dict[str, Float[Tensor, "_ _"]]:
    """Return camera name -> angle ``(h, w)`` of each pixel from the optical axis, radians; pi where there is no ray."""

    def angles(name: str) -> Tensor:
        camera = rig.cameras[name]
        return angle_from_axis(camera.unproject(camera.pixel_grid()).directions).nan_to_num(math.pi)

    return _of_cameras(rig, angles)


def _of_cameras(rig: CameraRig, make: Callable[[str], Made]) -> dict[str, Made]:
    """By name what is made of each camera, once of one that stands in several places, as in most rigs."""
    cache: dict[int, Made] = {}
    for name, camera in rig.cameras.items():
        if id(camera) not in cache:
            cache[id(camera)] = make(name)
    return {name: cache[id(camera)] for name, camera in rig.cameras.items()}


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
    photometer = Photometer(rig, depth)
    check_images_of(rig, images)
    return photometer.estimate(images).calibration()


class Photometer:
    """``calibrate_photometry`` of one rig, as often as wanted: what follows from the rig is computed once.

    Args:
        rig: a single rig.
        depth: as of ``calibrate_photometry``.
    """

    def __init__(self, rig: CameraRig, depth: float | None = None) -> None:
        check_single(rig)
        if depth is not None and not depth > 0:
            raise ArgumentError(f"depth: expected metres above 0, got {depth!r}")
        self._small = reduced_rig(rig, math.sqrt(4 * math.pi / _POINTS))

        def size(name: str) -> tuple[int, ...]:
            small, full = self._small.cameras[name].image_size, rig.cameras[name].image_size
            return tuple(min(_FINER * length, most) for length, most in zip(small, full, strict=True))

        fine = rig.resized(_of_cameras(rig, size))

        def view(name: str) -> tuple[Tensor, Tensor]:
            """Pixels that are seen as a whole, and the largest angle."""
            directions, inside = fine.cameras[name].unproject(fine.cameras[name].pixel_grid())
            edge = angle_from_axis(directions).where(inside, 0.0).amax()
            return resized_mask(inside, self._small.cameras[name].image_size), edge

        views = _of_cameras(rig, view)
        self._inside = {name: inside for name, (inside, _) in views.items()}
        self._edge = torch.stack([edge for _, edge in views.values()])
        radius = float(rig.radius)
        distances = [far * radius for far in _DISTANCES] if depth is None else [depth]
        inverse_depths = [1 / distance if distance > 0 else 0.0 for distance in distances]
        self._points = _Points(self._small, self._inside, self._edge, inverse_depths)

    def estimate(self, images: Mapping[str, Float[Tensor, "*batch c _ _"]]) -> LightEstimate:
        """Return exposure and vignetting as tensors: no number goes to the host, which would wait for a device.

        Args:
            images: as of ``calibrate_photometry``, not checked.
        """
        small = averaged(self._small, images)
        frames = [
            small[name].reshape(-1, *small[name].shape[-3:]) * inside for name, inside in self._inside.items()
        ]
        exposure, falloff, valid, residual = self._points.compared(frames)
        ends = _at_ends(exposure, falloff).flatten(1)
        # The jackknife: how strength differs without one part of the sphere each, of those that tell anything.
        strength = (ends[0] - 1).abs()
        others = ends[1:].index_select(1, strength.argmax()[None])[:, 0]
        number = valid.sum()
        mean = (others * valid).sum() / number.clamp(min=1)
        squares = ((others - mean).square() * valid).sum()
        spread = ((number - 1).clamp(min=0) * squares / number.clamp(min=1)).sqrt()
        return LightEstimate(exposure[0], falloff[0], self._edge, residual, spread, strength.amax())


class _Points:
    """Where points at some inverse depths, 1/m, fall in the images, and how much light is lost there.

    Of each two cameras there are the points that both may see, filled up to the same number. After that everything has
    a fixed shape: what the images cannot tell weighs nothing, and no row is taken out, so that a device never has to
    tell the host how many there are.
    """

    def __init__(
        self, rig: CameraRig, inside: Mapping[str, Tensor], edge: Tensor, inverse_depths: list[float]
    ) -> None:
        directions = cap(math.pi, _POINTS, next(iter(rig.cameras.values()))).to(rig.world_from_camera)
        depths = directions.new_tensor(inverse_depths)
        seen = rig.project_along(directions, depths)
        self.num_depths = len(inverse_depths)
        pixels, valid = seen.pixels.flatten(1, 2).unsqueeze(-2), seen.valid.flatten(1).unsqueeze(-1)
        self.lookups = [
            image_lookup(pixels[place], valid[place], camera.image_size, edges=camera.edges)
            for place, camera in enumerate(rig.cameras.values())
        ]
        # Near the border of its view a camera sees a part of a pixel only.
        weights = [
            look(inside[name][None].float()) for look, name in zip(self.lookups, rig.names, strict=True)
        ]
        self.share = torch.stack(weights).flatten(1)
        usable = self.share > 0.99
        # Of each two cameras that both see some point: their numbers, and which points these are.
        overlap = (usable[:, None] & usable).any(-1)
        self.one, self.other = overlap.tril(-1).nonzero().unbind(1)
        if not len(self.one):  # a camera and itself, which differ by nothing
            self.one = self.other = self.one.new_zeros(1)
        shared = (usable[self.one] & usable[self.other]).unflatten(-1, (self.num_depths, -1))
        anywhere = shared.any(1)
        most = max(1, int(anywhere.sum(-1).max()))
        self.columns = anywhere.byte().argsort(dim=-1, descending=True, stable=True)[:, :most]
        self.usable = self._of_pairs(shared[:, None, None].flatten(-2))  # (D, pairs, 1, points)
        sectors = (directions @ icosphere_vertices(0).to(directions).mT).argmax(-1)
        self.parts = F.one_hot(sectors, _PARTS)[self.columns].mT.double()  # (pairs, parts, points)
        offsets = (rig.center - rig.positions)[:, None, None].to(directions)
        rays = directions + depths[:, None, None] * offsets
        angles = angle_from_axis(rays.flatten(1, 2) @ rig.world_from_camera[:, :3, :3])
        has_lens = [not isinstance(camera, EquirectangularCamera) for camera in rig.cameras.values()]
        squared = (angles / edge[:, None]).clamp(max=1).square()
        squared = squared * torch.tensor(has_lens, device=squared.device)[:, None]
        # Double precision, because normal equations square the condition number.
        basis = torch.stack((squared, squared.square()), 1).double()
        # The row of an equation in the difference of two exposures and the falloff of either, [1, -basis, basis].
        one, other = (self._of_pairs(basis[numbers, None]) for numbers in (self.one, self.other))
        self.rows = torch.cat((torch.ones_like(one[:, :, :1]), -one, other), 2)  # (D, pairs, 5, points)
        self.squares = (self.rows[:, :, :, None] * self.rows[:, :, None]).flatten(2, 3)

    def compared(self, images: list[Tensor]) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """What explains images ``(b, c, h, w)``, a camera each, at the inverse depth where they agree best.

        Returns exposure ``(1 + parts, n, c)`` and falloff ``(1 + parts, n, 2)``, of all points and then without each
        part of the sphere in turn; which parts tell anything; and the residual.

        By weighted least squares, with new weights each round; without a part with the last weights of all points.
        """
        number, channels = len(images), images[0].shape[1]
        stacked = [look(frames) for look, frames in zip(self.lookups, images, strict=True)]
        values = torch.stack(stacked) / self.share[:, None, None].to(images[0]).clamp(min=0.5)
        good = (values.amin(2, keepdim=True) > _DARKEST) & (values.amax(2, keepdim=True) < _BRIGHTEST)
        logs = values.clamp(min=_DARKEST).log()
        difference = self._of_pairs(logs[self.one] - logs[self.other]).double()
        used = (good[self.one] & good[self.other]).expand(-1, -1, channels, -1)
        used = self._of_pairs(used) & self.usable
        to_all = self._to_all(number, channels)
        size = to_all.shape[-1]
        count = used.sum((1, 2, 3))
        # Where nothing can be compared nothing is to be explained: the regularisation alone decides for zero.
        hold = _held(number, channels, difference) * (count.clamp(min=1) / size)[:, None, None]
        scale, rest = difference.new_full((len(count),), 0.3), difference
        for _ in range(_ROUNDS):
            # Cauchy's weights: points that one camera sees hidden, or mirrored, differ by what no lens explains.
            weights = used / (rest / scale.view(-1, 1, 1, 1)).square_().add_(1)
            normal, target = self._normal(weights, weights * difference, to_all)
            mean = (weights.sum((1, 2, 3)) / count.clamp(min=1)).where(count > 0, 1.0)
            whole = normal[:, 0] + hold * mean[:, None, None]
            rest = self._rest(difference, solved(whole, target[:, 0]), to_all)
            # The standard deviation of a normal distribution with this median of absolute values.
            scale = 1.4826 * median_of_known(rest.abs().where(used, math.nan).flatten(1))
            scale = scale.clamp(min=0.01)
        residual = scale.where(count > 0, 0.0)
        best = residual.argmin()[None]
        whole, weights, difference, used = (
            each.index_select(0, best) for each in (whole, weights, difference, used)
        )
        normal, target = self._normal(weights, weights * difference, to_all, best)
        # Parts are as good as independent, which neighbouring points are not.
        without = torch.cat((whole, whole - normal[0]))
        targets = torch.cat((target[0].sum(0)[None], target[0].sum(0) - target[0]))
        answers = solved(without, targets).to(self.share)
        exposure, falloff = answers.split((number * channels, 2 * number), -1)
        valid = (used[0].any(1)[:, None] & (self.parts > 0)).any(-1).any(0)
        exposure, falloff = exposure.unflatten(1, (number, channels)), falloff.unflatten(1, (number, 2))
        return exposure, falloff, valid, residual.index_select(0, best)[0]

    def _of_pairs(self, values: Tensor) -> Tensor:
        """The points that both see ``(D, pairs, b * c, points)``, of ``(pairs, b, c, D * all points)``."""
        by_depth = values.flatten(1, 2).unflatten(-1, (self.num_depths, -1)).permute(2, 0, 1, 3)
        return by_depth.gather(-1, self.columns[:, None].expand(*by_depth.shape[:-1], -1))

    def _to_all(self, number: int, channels: int) -> Tensor:
        """``(pairs, c, 5, unknowns)``: which of all unknowns, and with which sign, a row's five values belong to.

        Unknown are exposures ``(n, c)``, then falloffs ``(n, 2)``.
        """
        each = torch.eye(number * channels + 2 * number, dtype=torch.float64, device=self.share.device)
        exposure = each[: number * channels].unflatten(0, (number, channels))
        falloff = each[number * channels :].unflatten(0, (number, 1, 2)).expand(-1, channels, -1, -1)
        difference = (exposure[self.one] - exposure[self.other]).unsqueeze(2)
        return torch.cat((difference, falloff[self.one], falloff[self.other]), 2)

    def _rest(self, difference: Tensor, unknown: Tensor, to_all: Tensor) -> Tensor:
        """The differences less what the unknowns ``(D, unknowns)`` explain of them."""
        own = torch.einsum("pcau,du->dpca", to_all, unknown)
        own = own.repeat(1, 1, difference.shape[2] // own.shape[2], 1)
        return difference - own @ self.rows

    def _normal(
        self, weights: Tensor, weighted: Tensor, to_all: Tensor, depth: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Normal equations ``(D, parts, unknowns, unknowns)`` and ``(D, parts, unknowns)`` of weights and differences.

        Of all points together, as one part; or, given the number of a depth ``(1,)`` that the weights are of, of the
        parts of the sphere.
        """
        rows, squares = (
            each if depth is None else each.index_select(0, depth) for each in (self.rows, self.squares)
        )

        def sums(factors: Tensor, of: Tensor) -> Tensor:
            """Over points and frames ``(D, parts, pairs, c, values)``."""
            grouped = factors.unflatten(2, (-1, to_all.shape[1])).sum(2)[:, :, None]
            if depth is not None:
                grouped = grouped * self.parts[:, :, None]
            return (grouped.flatten(2, 3) @ of.mT).unflatten(2, (-1, to_all.shape[1])).transpose(1, 2)

        products = sums(weights, squares).unflatten(-1, (5, 5)) @ to_all
        flat = to_all.flatten(0, 2)
        return flat.mT @ products.flatten(2, 4), sums(weighted, rows).flatten(2) @ flat


def _median(values: Float[Tensor, "rows number"]) -> Float[Tensor, " rows"]:
    """Return the lower median of each row of values of 0 or more, of those that are no NaN; 0 where there is none.

    Examples:
        >>> median_of_known(torch.tensor([[3.0, math.nan, 1.0, 2.0], [math.nan] * 4]))
        tensor([2., 0.])
    """
    return values.nanmedian(1).values.nan_to_num(0.0)


def _median_in_triton(values: Tensor) -> Tensor:
    from sphericalvision.capture.preparation import light_triton  # Triton is not everywhere

    return light_triton.nanmedian_kernel(values).nan_to_num(0.0).to(values.dtype)


median_of_known = Operator(_median, triton=_median_in_triton)


def _solve(matrix: Float[Tensor, "*b n n"], right: Float[Tensor, "*b n"]) -> Float[Tensor, "*b n"]:
    """Solve positive definite systems, on a device without a word to the host.

    Libraries report singular matrices to the host, which waits for them; these are never singular, and small.

    Examples:
        >>> solved(torch.tensor([[2.0, 1.0], [1.0, 2.0]]), torch.tensor([3.0, 0.0]))
        tensor([ 2., -1.])
    """
    return torch.linalg.solve(matrix, right)


def _solve_in_triton(matrix: Tensor, right: Tensor) -> Tensor:
    from sphericalvision.capture.preparation import light_triton  # Triton is not everywhere

    if right.shape[-1] > light_triton.LARGEST_SYSTEM:
        return NotImplemented
    return light_triton.elimination_kernel(matrix, right)


def eliminated(matrix: Float[Tensor, "*b n n"], right: Float[Tensor, "*b n"]) -> Float[Tensor, "*b n"]:
    """``solved`` by Gauss and Jordan's elimination: each step clears a column of all other rows.

    Examples:
        >>> eliminated(torch.tensor([[2.0, 1.0], [1.0, 2.0]]), torch.tensor([3.0, 0.0]))
        tensor([ 2., -1.])
    """
    system = torch.cat((matrix, right.unsqueeze(-1)), -1)
    unit = torch.eye(matrix.shape[-1], dtype=matrix.dtype, device=matrix.device)
    for place in range(matrix.shape[-1]):
        row = system[..., place, :] / system[..., place, place, None]
        column = system[..., place] - unit[place]
        system = torch.addcmul(system, column.unsqueeze(-1), row.unsqueeze(-2), value=-1)
    return system[..., -1]


solved = Operator(_solve, triton=_solve_in_triton, fused=eliminated)


def _held(number: int, channels: int, like: Tensor) -> Tensor:
    """The regularisation, as a quadratic form: it decides where the images do not."""
    size = number * channels
    own = torch.cat((like.new_full((size,), _HOLD_EXPOSURE), like.new_full((2 * number,), _HOLD_FALLOFF)))
    identity = torch.eye(number, dtype=like.dtype, device=like.device)
    # Each camera's two, as all cameras' mean
    alike = torch.kron(identity - 1 / number, identity.new_ones(2).diag())
    return own.diag() + F.pad(_HOLD_ALIKE * alike, (size, 0, size, 0))


def reduced_rig(rig: CameraRig, pixel: float) -> CameraRig:
    """Return the rig of images whose pixels are not finer than ``pixel``, in radians at the optical axis.

    Examples:
        >>> from sphericalvision.cameras import ring_rig
        >>> reduced_rig(ring_rig(3, image_size=(768, 800)), 0.02).cameras["cam1"].image_size
        (192, 200)
    """

    def size(name: str) -> tuple[int, ...]:
        camera = rig.cameras[name]
        shrink = max(1, int(pixel * pixels_a_radian(camera)))
        return tuple(max(1, round(length / shrink)) for length in camera.image_size)

    return rig.resized(_of_cameras(rig, size))


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
