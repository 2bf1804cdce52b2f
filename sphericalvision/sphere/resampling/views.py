# SPDX-License-Identifier: Apache-2.0
"""Perspective views of a panorama or a rig, any function of them, and the way back."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Shaped
from torch import Tensor

from sphericalvision.cameras import Camera, CameraRig, EquirectangularCamera, PinholeCamera, depth_from_z
from sphericalvision.cameras.base import check_single
from sphericalvision.cameras.remapping.lookup import pixels_a_radian
from sphericalvision.cameras.remapping.rectify import RectifiedPair
from sphericalvision.cameras.remapping.yaw_pitch_roll import rotation_from_yaw_pitch_roll
from sphericalvision.cameras.sphere_images import images_in_order
from sphericalvision.core import ArgumentError, ShapeError, check_choice, check_tensor
from sphericalvision.geometry.directions import holds
from sphericalvision.sphere.grids.cube_layouts import world_from_cube_face
from sphericalvision.sphere.grids.sphere_grid import SphereGrid, check_values
from sphericalvision.sphere.grids.tangent import TangentImages
from sphericalvision.sphere.resampling.merge import pixel_weights, robust_mean
from sphericalvision.sphere.resampling.reprojection import distances_from
from sphericalvision.sphere.resampling.resample_tables import resample_tables
from sphericalvision.sphere.resampling.scales import log_scales
from sphericalvision.sphere.resampling.supersampling import cell_widths, grid_shape

QUANTITIES = ("values", "range", "z")
_INFINITY = 1e3  # baselines, beyond which a pair measures no distance


class Merged(NamedTuple):
    """The merged image of several views."""

    values: Float[Tensor, "*values"]
    """``(*b, c, *target_shape)``, 0 where not valid."""
    valid: Bool[Tensor, "*target"]
    """``(*b, *target_shape)``, where a view shows something."""
    spread: Float[Tensor, "*target"]
    """``(*b, *target_shape)``: weighted deviation of the views from the merged values; relative for depth."""


class Views:
    """Images of several cameras that look from one place, such as ``views`` cuts: photographs of a rig are views, too.

    Args:
        images: ``(*b, c, h, w)`` of each camera, by name or in the rig's order; floating point.
        rig: cameras, their orientations and masks; where the cameras stand matters for ``merge(center=...)`` alone.
        target: default of ``merge``; a panorama with the cameras' resolution in their middle if not given.

    Raises:
        ArgumentError: the number or the names of the images are not those of the rig, or the rig is a batch.
        ShapeError: an image is not of its camera's size.

    Examples:
        >>> from sphericalvision.cameras import ring_rig
        >>> photographs = Views([torch.rand(3, 64, 64) for _ in range(4)], ring_rig(4, image_size=(64, 64)))
        >>> photographs.merge(EquirectangularCamera((32, 64))).values.shape
        torch.Size([3, 32, 64])
    """

    def __init__(
        self,
        images: Mapping[str, Float[Tensor, "*#b c _ _"]] | Sequence[Float[Tensor, "*#b c _ _"]],
        rig: CameraRig,
        target: SphereGrid | Camera | None = None,
    ) -> None:
        check_single(rig)
        self.images = images_in_order(rig, images)
        self.rig = rig
        self._target = target

    @classmethod
    def of_pairs(
        cls,
        pairs: Sequence[RectifiedPair],
        disparities: Sequence[Float[Tensor, "*#b _ _"]],
        target: SphereGrid | Camera | None = None,
    ) -> Views:
        """The distances measured by rectified pairs, seen from their left cameras, for ``merge`` with
        ``quantity="range"``, ``align=False`` and ``center=rig.center``.

        Args:
            pairs: of one rig.
            disparities: ``(*b, h, w)`` of each pair's left image, in pixels; what is below 0 or NaN is unknown.
            target: default of ``merge``.

        Examples:
            >>> from sphericalvision.cameras import rectified_pairs, ring_rig
            >>> rig = ring_rig(4, image_size=(64, 64))
            >>> pairs = rectified_pairs(rig)
            >>> wall = [pair.disparity(torch.full(pair.image_size, 3.0))[0] for pair in pairs]  # from each left camera
            >>> merged = Views.of_pairs(pairs, wall, EquirectangularCamera((32, 64))).merge(
            ...     quantity="range", align=False, center=rig.center
            ... )
            >>> merged.values.shape, bool((merged.values[0][merged.valid] - 3).abs().median() < 0.1)
            (torch.Size([1, 32, 64]), True)
        """
        if len(pairs) != len(disparities) or not pairs:
            raise ArgumentError(
                f"disparities: expected one for each of {len(pairs)} pairs, got {len(disparities)}"
            )
        images = []
        for pair, disparity in zip(pairs, disparities, strict=True):
            distance = pair.distance(disparity)[0].clamp(max=_INFINITY * float(pair.baseline))
            images.append(pair.upright(distance).unsqueeze(-3))
        cameras = {"-".join(pair.names): pair.camera for pair in pairs}
        return cls(
            images, CameraRig(cameras, torch.stack([pair.rig.world_from_camera[0] for pair in pairs])), target
        )

    @property
    def target(self) -> SphereGrid | Camera:
        """The default target of ``merge``."""
        if self._target is not None:
            return self._target
        rows = round(math.pi * _fineness(self.rig))
        return EquirectangularCamera((rows, 2 * rows))

    def map(self, function: Callable[[Tensor], Tensor], batch: int | None = None) -> Views:
        """The views of the results of ``function``.

        Args:
            function: of images ``(n, c, h, w)`` to ``(n, c', h', w')`` or ``(n, h', w')``, such as a network.
            batch: maximum of images in a call; all of one size if not given.
        """
        results: list[Tensor] = []
        for _, alike in itertools.groupby(self.images, lambda image: image.shape):
            images = torch.stack(list(alike))
            chunks = images.flatten(0, -4).split(batch or images.shape[:-3].numel())
            outputs = torch.cat([self._checked(function(part), part) for part in chunks])
            results += outputs.unflatten(0, images.shape[:-3])
        sizes = {name: tuple(image.shape[-2:]) for name, image in zip(self.rig.names, results, strict=True)}
        return Views(results, self.rig.resized(sizes), self._target)

    @staticmethod
    def _checked(result: Tensor, images: Tensor) -> Tensor:
        check_tensor("function", result, "(n, c, h, w)")
        result = result.unsqueeze(1) if result.ndim == 3 else result
        if result.ndim != 4 or len(result) != len(images):
            raise ShapeError(
                f"function: expected ({len(images)}, c, h, w), of images {tuple(images.shape)}, got "
                f"{tuple(result.shape)}"
            )
        return result

    def merge(
        self,
        target: SphereGrid | Camera | None = None,
        rotation: Float[Tensor, "3 3"] | None = None,
        *,
        quantity: str = "values",
        align: bool = True,
        mode: str = "bilinear",
        center: Float[Tensor, " 3"] | None = None,
    ) -> Merged:
        """One image of all views, on any grid or in any camera.

        Views count by the solid angle of their pixels, less towards their borders, and less where they disagree with
        the others (Cauchy's weights, by the mean deviation of all).

        Args:
            target: grid or camera; where the views were cut from if not given.
            rotation: ``(3, 3)``, target_from_world.
            quantity: what the images hold. ``"values"`` of any kind: colours, features, scores of classes. ``"range"``:
                metres along each pixel's ray. ``"z"``: metres along each camera's axis, as networks for perspective
                images estimate; the result is along the rays. Of depth, what is not above 0 is not known.
            align: whether each view's depth has its own unknown scale; these are estimated where views overlap, and
                their geometric mean is kept.
            mode: as in ``resample``; ``"area"`` where the target is coarser.
            center: ``(3,)`` in the rig's world, the origin of the merged depth. Then the cameras' positions count: each
                view's surface is intersected with rays from the centre, bilinear and without gradients. When not
                given, all views are taken to be from one place.

        Raises:
            ArgumentError: an unknown quantity, depth of several channels, or a centre for what is no depth.
        """
        check_choice("quantity", quantity, QUANTITIES)
        is_depth = quantity != "values"
        if center is not None and (not is_depth or mode != "bilinear"):
            raise ArgumentError(
                f"center: expected with depth and mode 'bilinear', got {quantity!r} and {mode!r}"
            )
        target = self.target if target is None else target
        pairs = [self._project_to(target, rotation, name, quantity, mode, center) for name in self.rig.names]
        values, weights = (torch.stack(torch.broadcast_tensors(*each)) for each in zip(*pairs, strict=True))
        dims = len(grid_shape(target, "target"))
        if is_depth:
            # Scales of views are factors of their depth: in logarithms they are added, and means are geometric ones.
            values = torch.where(weights > 0, values, 1.0).log()
            if align:
                values = values + log_scales(values, weights, dims)
        merged, spread = robust_mean(values, weights, dims)
        valid = (weights > 0).any(0)
        merged = torch.where(valid, merged.exp() if is_depth else merged, 0.0)
        return Merged(merged, valid.squeeze(-1 - dims), spread.squeeze(-1 - dims))

    def _project_to(
        self,
        target: SphereGrid | Camera,
        rotation: Tensor | None,
        name: str,
        quantity: str,
        mode: str,
        center: Tensor | None,
    ) -> tuple[Tensor, Tensor]:
        """Values of a view in the target ``(*b, c, *target_shape)``, and their weights, 0 where it has none."""
        index = self.rig.names.index(name)
        camera, image = self.rig.cameras[name].to(self.images[index].device), self.images[index]
        target_from_camera = self.rig.world_from_camera[index, :3, :3].to(image.device)
        if rotation is not None:
            target_from_camera = rotation.to(target_from_camera) @ target_from_camera
        mask = self.rig.masks.get(name)
        usable = torch.ones(camera.image_size, dtype=torch.bool) if mask is None else mask
        usable = usable.to(image.device)
        if quantity != "values":
            if image.shape[-3] != 1:
                raise ArgumentError(f"quantity: depth has one channel, got {image.shape[-3]}")
            depth = image.squeeze(-3)
            if quantity == "z":
                depth, _ = depth_from_z(depth, camera)  # 0 where unknown
            usable = usable & (depth > 0) & depth.isfinite()
            # Inverse depth of a plane is linear in directions, so that interpolated planes stay planes.
            image = (1 / torch.where(usable, depth, 1.0)).unsqueeze(-3)
        weight = pixel_weights(camera).to(image).expand_as(image[..., :1, :, :])
        if center is not None:
            pose = self.rig.world_from_camera[index].to(image)
            start = (center.to(image) - pose[:3, 3]) @ pose[:3, :3]
            return distances_from(start, target, target_from_camera, camera, image, weight, usable)
        tables = resample_tables(camera, target, target_from_camera, mode, 0.0, usable, image.device)
        dims = len(tables.target_shape)
        result, seen = tables(torch.cat((image, weight), -3)), tables.mask().unsqueeze(-1 - dims)
        result_values, weight = result.split((image.shape[-3], 1), -1 - dims)
        if quantity != "values":
            result_values = 1 / torch.where(seen, result_values, 1.0)
        return result_values, torch.where(seen, weight, 0.0)


def views(
    image: Shaped[Tensor, "*images c h w"] | Mapping[str, Tensor] | Sequence[Tensor],
    source: SphereGrid | Camera | CameraRig | None = None,
    layout: str | Float[Tensor, "n 3"] | Sequence[Sequence[float]] = "cube",
    field_of_view: float | Sequence[float] = math.radians(100),
    image_size: Sequence[int] | None = None,
    mode: str = "bilinear",
) -> Views:
    """Perspective views that cover the sphere, for functions of ordinary images: ``views(panorama).map(f).merge()``.

    Args:
        image: ``(*b, c, h, w)`` of a panorama or another camera, or one for each camera of a rig.
        source: what took it: camera, grid or rig (seen from its middle as if all were far away). A whole panorama if
            not given.
        layout: ``"cube"``, 6 views; ``"tangent"``, 20 views, one at each face of an icosahedron (75° and more); or
            yaw, pitch and roll ``(n, 3)`` in radians, as in ``rotation_from_yaw_pitch_roll``.
        field_of_view: across the shorter side, or (horizontal, vertical), in radians. What overlaps aligns the views.
        image_size: (height, width); as fine as the source in the middle of a view if not given.
        mode: as in ``resample``.

    Raises:
        ArgumentError: an unknown layout, or a field of view that no pinhole has.
        ShapeError: the image is not of the source's size, or angles are not (n, 3).

    References:
        M. Eder et al. (2020), "Tangent images for mitigating spherical distortion", CVPR.
        M. Rey-Area et al. (2022), "360MonoDepth: high-resolution 360° monocular depth estimation", CVPR, for depth of
        tangent images aligned where they overlap.

    Examples:
        >>> panorama = torch.rand(3, 64, 128)
        >>> brighter = views(panorama).map(lambda images: images + 1).merge()
        >>> brighter.values.shape, bool(brighter.valid.all())
        (torch.Size([3, 64, 128]), True)
    """
    if isinstance(source, CameraRig):
        photographs = Views(image.unbind(-4) if isinstance(image, Tensor) else image, source)
        whole: SphereGrid | Camera = photographs.target
    else:
        check_tensor("image", image, "(*b, c, h, w)")
        assert isinstance(image, Tensor)
        whole = EquirectangularCamera(tuple(image.shape[-2:])) if source is None else source
        check_values(image, grid_shape(whole, "source"))
        panorama: Tensor = image

    def cut(camera: Camera, turn: Tensor) -> tuple[Tensor, Tensor]:
        if isinstance(source, CameraRig):
            return photographs.merge(camera, turn, mode=mode)[:2]
        device = panorama.device
        tables = resample_tables(whole, camera, turn.to(device), mode, 0.0, None, device)
        return tables(panorama), tables.mask()

    rotations = _rotations(layout)
    if image_size is None:
        pair = field_of_view if isinstance(field_of_view, Sequence) else (field_of_view,) * 2
        fineness = _fineness(source if isinstance(source, CameraRig) else whole)
        across, down = (math.ceil(2 * math.tan(angle / 2) * fineness) for angle in pair)
        image_size = (down, across)
    lens = PinholeCamera.from_field_of_view(image_size, field_of_view)
    images, seen = zip(*(cut(lens, turn.mT) for turn in rotations), strict=True)
    poses = torch.eye(4).repeat(len(rotations), 1, 1)
    poses[:, :3, :3] = rotations
    rig = CameraRig([lens] * len(rotations), poses)
    masks = {name: mask for name, mask in zip(rig.names, seen, strict=True) if not holds(mask)}
    return Views(images, CameraRig(rig.cameras, poses, masks), whole)


def _fineness(source: SphereGrid | Camera | CameraRig) -> float:
    """Values a radian; of cameras in their middle, the finest of a rig."""
    if isinstance(source, Camera):
        return pixels_a_radian(source)
    if isinstance(source, CameraRig):
        return max(map(pixels_a_radian, source.cameras.values()))
    return 1 / float(cell_widths(source).min())


def _rotations(layout: str | Tensor | Sequence[Sequence[float]]) -> Tensor:
    """Rotations (n, 3, 3), world_from_view."""
    if isinstance(layout, str):
        check_choice("layout", layout, ("cube", "tangent"))
        return world_from_cube_face() if layout == "cube" else TangentImages(0, 2).world_from_patch
    angles = torch.as_tensor(layout, dtype=torch.float64)
    if angles.ndim != 2 or angles.shape[-1] != 3:
        raise ShapeError(f"layout: expected (n, 3) as yaw, pitch and roll, got shape {tuple(angles.shape)}")
    if not holds(angles.abs() <= 2 * math.pi + 1e-3):
        raise ArgumentError(
            f"layout: expected radians within ±2π, got {float(angles.abs().max()):g}; are these degrees?"
        )
    return rotation_from_yaw_pitch_roll(angles).float()
