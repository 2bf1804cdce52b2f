# SPDX-License-Identifier: Apache-2.0
"""Rectified pairs of a rig's cameras: stereo images for planar networks, beyond 180° as well."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Bool, Float, Shaped
from torch import Tensor

from sphericalvision.cameras.base import Camera, Projection, check_single
from sphericalvision.cameras.checks import at_least_float32, check_image, checked_size
from sphericalvision.cameras.models.equirectangular import EquirectangularCamera
from sphericalvision.cameras.models.pinhole import PinholeCamera
from sphericalvision.cameras.remapping.lookup import pixels_a_radian
from sphericalvision.cameras.remapping.remap import Remap, remap, remap_mask
from sphericalvision.cameras.rig import CameraRig, check_images_of
from sphericalvision.core import ArgumentError, check_choice, check_last_dim, check_type
from sphericalvision.geometry import normalize
from sphericalvision.kernels import full_precision

PAIR_KINDS = ("cassini", "pinhole", "equirectangular")
_WIDEST = math.tan(math.radians(60))  # of a pinhole image, whose pixels grow without end towards 90°
_COARSE = 128  # rows of the image in which the common field of view is looked for


class _NoPairError(ArgumentError):
    """Two cameras that are no stereo pair."""


@dataclass(frozen=True, eq=False)
class RectifiedPair:
    """Two cameras as a stereo pair: what both see lies in the same row of both images, further left in the right one.

    In ``"equirectangular"`` images, whose poles lie on the line through the cameras, it lies in the same column,
    further up in the second image; a Cassini image is such a panorama turned a quarter to the left.

    Made by ``rectified_pairs``.

    Attributes:
        source: the two cameras as they are, the left (upper) one first.
        rig: the virtual cameras, which are equal and turned alike, at the places of the real ones. For Cassini images
            these are panoramas, and images of theirs lie a quarter to the right; all methods here speak of the images.
        kind: ``"cassini"``, ``"pinhole"`` or ``"equirectangular"``.

    Examples:
        >>> from sphericalvision.cameras import ring_rig
        >>> pair = rectified_pairs(ring_rig(4, image_size=(64, 64)), pairs=[("cam1", "cam2")])[0]
        >>> pixels, valid = pair.project(torch.tensor([[0.7, 0.1, 0.9]]))
        >>> bool(valid.all()), [round(x, 3) for x in (pixels[0] - pixels[1])[0].tolist()]  # along the row
        (True, [4.584, 0.0])
    """

    source: CameraRig
    rig: CameraRig
    kind: str

    @property
    def names(self) -> tuple[str, str]:
        """Of the left camera and the right one; of equirectangular pairs the upper and the lower."""
        first, second = self.source.names
        return first, second

    @property
    def camera(self) -> Camera:
        """The virtual camera, the same on both sides."""
        return self.rig.cameras[self.names[0]]

    @property
    def image_size(self) -> tuple[int, int]:
        """(height, width) of both images."""
        height, width = self.camera.image_size
        return (width, height) if self.kind == "cassini" else (height, width)

    @property
    def baseline(self) -> Float[Tensor, ""]:
        """Metres between the cameras."""
        return self.rig.baselines[0, 1]

    @property
    def epipolar_dim(self) -> int:
        """Dimension of images ``(*, h, w)`` along which disparity is: −1, of equirectangular pairs −2."""
        return -2 if self.kind == "equirectangular" else -1

    @full_precision
    def rectify(
        self, images: Mapping[str, Shaped[Tensor, "*#b c _ _"]] | Sequence[Shaped[Tensor, "*#b c _ _"]]
    ) -> tuple[Shaped[Tensor, "*b c h w"], Shaped[Tensor, "*b c h w"]]:
        """The left and the right image ``(*b, c, h, w)``, 0 where not ``seen``.

        Differentiable with respect to the images and, where they require it, the poses of the rig.

        Args:
            images: ``(*b, c, h, w)`` by name, of the whole rig or the two cameras, or those of the two in the order of
                ``names``.

        Raises:
            ArgumentError: an image lacks, or there are more than two without names.
            ShapeError: an image is not of its camera's size.
        """
        if not isinstance(images, Mapping) and len(images) != 2:
            raise ArgumentError(
                f"images: expected those of {' and '.join(self.names)}, got {len(images)}; a mapping may hold all"
            )
        named = images if isinstance(images, Mapping) else dict(zip(self.names, images, strict=True))
        check_images_of(self.source, {name: named[name] for name in self.names if name in named})
        if self.source.world_from_camera.requires_grad:
            left, right = (
                self._turned(remap(named[name], self.source.cameras[name], self.camera, turn))
                for name, turn in zip(self.names, self._turns, strict=True)
            )
        else:
            left, right = (
                self._turned(table.to(named[name].device)(named[name]))
                for name, table in zip(self.names, self._tables, strict=True)
            )
        return left, right

    @cached_property
    def seen(self) -> Bool[Tensor, "2 h w"]:
        """Where the left and the right camera, and the usable pixels of their masks, show something."""
        return self._turned(torch.stack([table.mask() for table in self._tables]))

    @full_precision
    def project(self, points: Float[Tensor, "P 3"]) -> Projection:
        """Pixels ``(2, P, 2)`` of points ``(P, 3)`` of the world in both images, and whether both camera and image
        have them, ``(2, P)``.
        """
        pixels, valid = self.rig.project(points)
        if self.kind == "cassini":
            u, v = pixels.unbind(-1)
            pixels = torch.stack((v, self.camera.image_size[1] - 1 - u), -1)
        return Projection(pixels, valid & self.source.project(points).valid)

    @full_precision
    def to_directions(self, pixels: Float[Tensor, "*pixels 2"] | None = None) -> Float[Tensor, "*pixels 3"]:
        """Unit directions ``(*, 3)`` in the world of pixels ``(*, 2)``, of all pixels ``(h, w, 3)`` when not given.

        The direction is the same for both images; it starts at each camera's own place.
        """
        pose = self.rig.world_from_camera[0, :3, :3]
        if pixels is None:
            return (
                self._turned(self._directions(pose.dtype, pose.device).movedim(-1, 0)).movedim(0, -1)
                @ pose.mT
            )
        check_last_dim("pixels", pixels, 2)
        if self.kind == "cassini":
            u, v = pixels.unbind(-1)
            pixels = torch.stack((self.camera.image_size[1] - 1 - v, u), -1)
        directions = self.camera.unproject(pixels).directions
        return directions @ pose.to(directions).mT

    @full_precision
    def distance(
        self, disparity: Float[Tensor, "*b h w"], of: str | None = None
    ) -> tuple[Float[Tensor, "*b h w"], Bool[Tensor, "*b h w"]]:
        """Metres along the rays of one image, from its camera, of a disparity in pixels.

        With pinholes distance · z = f · B / d for the z of the pixel's ray; with panoramas the law of sines,
        distance = B · sin(α + δ) / sin δ, for the parallax δ in radians and the angle α between the line to the right
        camera and the left ray (for the right image α − δ). A disparity of 0 is infinity.

        Args:
            disparity: ``(*b, h, w)`` pixels, how much further left (up) the other image shows what this pixel shows;
                of the right image how much further right.
            of: the camera whose image it is; the left one when not given.

        Returns:
            ``(*b, h, w)`` metres, 0 where not valid, and where the disparity is 0 or more, both cameras see what it
            says, and the two rays meet.

        Raises:
            ShapeError: the disparity is not of the images' size.
            ArgumentError: the pair has no camera ``of``.
        """
        side, sign, disparity = self._checked("disparity", disparity, of)
        baseline, forward, along, across = self._rays(disparity)
        seen = self._seen_by_both(disparity, side)
        valid = seen & (disparity >= 0)
        if isinstance(self.camera, PinholeCamera):
            gap = torch.where(valid, disparity, 1.0) * forward
            metres = baseline * self.camera.focal_length[0].to(gap) / gap
        else:
            angle = torch.atan2(across, along)
            parallax = torch.where(valid, disparity * self._step, 0.1)
            valid = valid & (parallax < math.pi) & ((angle + sign * parallax).sin() > 0)
            metres = baseline * (angle + sign * parallax).sin() / parallax.sin()
        return torch.where(valid, metres, 0.0), valid

    @full_precision
    def disparity(
        self, distance: Float[Tensor, "*b h w"], of: str | None = None
    ) -> tuple[Float[Tensor, "*b h w"], Bool[Tensor, "*b h w"]]:
        """The disparity in pixels of metres along the rays of one image: the inverse of ``distance``.

        Args:
            distance: ``(*b, h, w)`` metres from the camera; infinity is allowed, what is not above 0 is unknown.
            of: the camera whose image it is; the left one when not given.

        Returns:
            ``(*b, h, w)`` pixels, 0 where not valid, and where the distance is known and both cameras see that point.

        Raises:
            ShapeError: the distance is not of the images' size.
            ArgumentError: the pair has no camera ``of``.
        """
        side, sign, distance = self._checked("distance", distance, of)
        baseline, forward, along, across = self._rays(distance)
        positive = distance > 0
        inverse = baseline / torch.where(positive, distance, 1.0)
        if isinstance(self.camera, PinholeCamera):
            pixels = inverse * self.camera.focal_length[0].to(inverse) / forward
        else:
            pixels = torch.atan2(inverse * across, 1 - sign * inverse * along) / self._step
        valid = positive & self._seen_by_both(pixels, side)
        return torch.where(valid, pixels, 0.0), valid

    # What follows from the cameras --------------------------------------------------------------------------------

    @property
    def _turns(self) -> Float[Tensor, "2 3 3"]:
        """From each real camera to its virtual one."""
        return self.rig.world_from_camera[:, :3, :3].mT @ self.source.world_from_camera[:, :3, :3]

    @cached_property
    def _tables(self) -> list[Remap]:
        return [
            Remap(self.source.cameras[name], self.camera, turn, mask=self.source.masks.get(name))
            for name, turn in zip(self.names, self._turns.detach(), strict=True)
        ]

    def _turned(self, images: Tensor) -> Tensor:
        """Images of the virtual cameras as images of the pair."""
        return torch.rot90(images, 1, (-2, -1)) if self.kind == "cassini" else images

    def upright(self, images: Shaped[Tensor, "*b h w"]) -> Shaped[Tensor, "*b _ _"]:
        """Images of the pair as images of ``camera``: those of Cassini's a quarter to the right, others as they are."""
        return torch.rot90(images, -1, (-2, -1)) if self.kind == "cassini" else images

    @property
    def _step(self) -> float:
        """Radians of a pixel along the epipolar line of a panorama."""
        assert isinstance(self.camera, EquirectangularCamera)
        return self.camera.vertical_field_of_view / self.camera.image_size[0]

    def _directions(self, dtype: torch.dtype, device: torch.device) -> Tensor:
        """Directions of the virtual camera's pixels (*camera.image_size, 3)."""
        camera = self.camera.to(device)
        return camera.unproject(camera.pixel_grid(dtype)).directions

    def _rays(self, like: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """The baseline, and of each pixel's ray (h, w) the parts forward, along the baseline and across it."""
        x, y, z = self._turned(self._directions(like.dtype, like.device).movedim(-1, 0)).unbind(0)
        along, other = (x, y) if isinstance(self.camera, PinholeCamera) else (y, x)
        return self.baseline.to(like), z, along, torch.hypot(other, z)

    def _checked(self, name: str, values: Tensor, of: str | None) -> tuple[int, int, Tensor]:
        """Which image values belong to, the sign of its disparities, and the values in single precision at least."""
        check_image(name, values, self.image_size, "(*b, h, w)", "it belongs to images of rectify")
        if of is not None:
            check_choice("of", of, self.names)
        side = 0 if of is None else self.names.index(of)
        return side, (1, -1)[side], at_least_float32(name, values)

    def _seen_by_both(self, disparity: Tensor, side: int) -> Tensor:
        """Where the pixels of one image and those that a disparity away of the other one are seen."""
        dim, seen = self.epipolar_dim, self.seen.to(disparity.device)
        size = disparity.shape[dim]
        pixel = torch.arange(size, device=disparity.device, dtype=disparity.dtype)
        pixel = pixel.unsqueeze(-1) if dim == -2 else pixel
        other = pixel - (1, -1)[side] * disparity.detach()
        inside = (other >= -0.5) & (other <= size - 0.5)
        index = torch.where(inside, other, 0.0).round().long().clamp(0, size - 1)
        return inside & seen[side] & seen[1 - side].expand(disparity.shape).gather(dim, index)


def rectified_pairs(
    rig: CameraRig,
    kind: str = "cassini",
    pairs: Sequence[tuple[str, str]] | None = None,
    image_size: Sequence[int] | None = None,
) -> list[RectifiedPair]:
    """Rectified pairs of a rig's cameras, of any models, for stereo methods that look along rows.

    Both cameras are turned about themselves until the line through them is the x axis of both and the middle of their
    optical axes is ahead; nothing is stretched by calibration errors, and no camera moves. The left camera is the one
    for which the image stands upright. The images are as fine as the finer camera in its middle, and as large as
    what both cameras see, at any distance.

    * ``"cassini"``: a column is an angle from the plane across the baseline, a row an angle around it; up to the whole
      sphere, also of cameras that look away from each other.
    * ``"pinhole"``: perspective, at most 60° to each side, as most planar networks were trained.
    * ``"equirectangular"``: a panorama whose poles are on the baseline, disparity along columns, for networks of
      panoramas one above the other.

    Args:
        rig: single.
        kind: of the images.
        pairs: names of two cameras each; all that share a field of view when not given.
        image_size: (height, width) of the images, such as a network wants; pixels need not be square then.

    Raises:
        ArgumentError: an unknown kind or camera, cameras in one place, or that share no field of view.

    References:
        A. Fusiello, E. Trucco, A. Verri (2000), "A compact algorithm for rectification of stereo pairs".
        S. Li (2008), "Binocular spherical stereo", for the panoramas.

    Examples:
        >>> from sphericalvision.cameras import ring_rig
        >>> rig = ring_rig(4, image_size=(64, 64))  # 220°, to the front, right, back and left
        >>> pairs = rectified_pairs(rig)
        >>> [pair.names for pair in pairs][:3], pairs[0].image_size
        ([('cam1', 'cam2'), ('cam1', 'cam3'), ('cam4', 'cam1')], (70, 40))
        >>> left, right = pairs[0].rectify({name: torch.rand(3, 64, 64) for name in rig.names})
        >>> left.shape, pairs[0].distance(torch.full(pairs[0].image_size, 4.0))[0].max() > 0.5
        (torch.Size([3, 70, 40]), tensor(True))
    """
    check_type("rig", rig, CameraRig)
    check_single(rig)
    check_choice("kind", kind, PAIR_KINDS)
    size = None if image_size is None else checked_size(image_size)
    if pairs is not None:
        return [_pair(rig.subset(list(names)), kind, size) for names in pairs]
    result = []
    for names in itertools.combinations(rig.names, 2):
        try:
            result.append(_pair(rig.subset(list(names)), kind, size))
        except _NoPairError:
            continue
    if not result:
        raise ArgumentError(
            f"rig: no two of the cameras {', '.join(rig.names)} stand apart and share a field of view"
        )
    return result


@full_precision
def _pair(source: CameraRig, kind: str, image_size: tuple[int, int] | None) -> RectifiedPair:
    """The pair of a rig of two, which are put in order."""
    if len(source) != 2:
        raise ArgumentError(f"pairs: expected two names each, got {source.names}")
    if not float(source.baselines.detach()[0, 1]) > 1e-6:
        raise _NoPairError(f"pairs: {' and '.join(source.names)} stand in one place, which gives no parallax")
    axes = source.world_from_camera[:, :3, :3]
    right = normalize(source.positions[1] - source.positions[0])
    forward = _ahead(right, axes)
    down = torch.linalg.cross(forward, right)
    upright = (right if kind == "equirectangular" else down) @ axes[:, :, 1].sum(0)
    if float(upright.detach()) < -1e-6:
        source, right, down = source.subset([1, 0]), -right, -down
    columns = (right, down, forward) if kind == "pinhole" else (-down, right, forward)
    poses = source.world_from_camera.clone()
    poses[:, :3, :3] = torch.stack(columns, -1)
    camera = _virtual_camera(source, poses, kind, image_size)
    rig = CameraRig(dict.fromkeys(source.names, camera), poses, origin=source.origin)
    return RectifiedPair(source, rig, kind)


def _ahead(right: Tensor, axes: Tensor) -> Tensor:
    """The unit vector across the baseline between the optical axes; across their downs where these lie along it."""
    forward, down = axes[:, :, 2], axes[:, :, 1]
    around = [torch.linalg.cross(right, vector) for vector in (down.sum(0), down[0])]
    for vector in (forward.sum(0), around[0], forward[0], around[1]):
        across = vector - (vector @ right) * right
        if float(across.detach().norm()) > 0.1:
            return normalize(across)
    raise AssertionError("the axes of a camera are at right angles: one is across the baseline")


@torch.no_grad()
def _virtual_camera(
    source: CameraRig, poses: Tensor, kind: str, image_size: tuple[int, int] | None
) -> Camera:
    """As fine as the finer camera, and as large as what both see at any distance."""
    fineness = max(map(pixels_a_radian, source.cameras.values()))
    whole: Camera
    if kind == "pinhole":
        side = 2 * math.ceil(_WIDEST * fineness)
        whole = PinholeCamera([fineness] * 2, [(side - 1) / 2] * 2, (side, side))
    else:
        rows = 2 * round(math.pi / 2 * fineness)
        whole = EquirectangularCamera((rows, 2 * rows))
    rows = min(whole.image_size[0], _COARSE)
    coarse = whole.resized((rows, rows * whole.image_size[1] // whole.image_size[0]))
    rotations = poses[:, :3, :3].mT @ source.world_from_camera[:, :3, :3]
    seen = torch.stack(
        [
            remap_mask(camera, coarse.to(camera.device), turn, mask=source.masks.get(name))
            for (name, camera), turn in zip(source.cameras.items(), rotations, strict=True)
        ]
    )
    dim = -1 if kind == "pinhole" else -2
    # What is near lies further right in the left image: a line shows something to both where the left camera sees
    # as far right as the right camera begins, and nothing beyond these two places matters.
    size = seen.shape[dim]
    begins = torch.where(seen[1].any(dim), seen[1].int().argmax(dim), size)
    ends = torch.where(seen[0].any(dim), size - 1 - seen[0].flip(dim).int().argmax(dim), -1)
    lines = (begins <= ends).nonzero()[:, 0]
    if not len(lines):
        raise _NoPairError(f"pairs: {' and '.join(source.names)} share no field of view in {kind} images")
    across, along = (int(lines[0]), int(lines[-1])), (int(begins[lines].min()), int(ends[lines].max()))
    boxes = (across, along) if dim == -1 else (along, across)
    edges = []
    for (first, last), end, count in zip(boxes, whole.image_size, coarse.image_size, strict=True):
        scale = end / count
        edges += [max(0, math.floor((first - 1) * scale)), min(end, math.ceil((last + 2) * scale))]
    top, bottom, left, right = edges
    camera = whole.cropped(top, left, bottom - top, right - left)
    if image_size is not None:
        camera = camera.resized(image_size[::-1] if kind == "cassini" else image_size)
    return camera.to(poses.device, poses.dtype)
