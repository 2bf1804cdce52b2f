# SPDX-License-Identifier: Apache-2.0
"""Several cameras that are rigidly fixed to each other.

Convention:
    ``world_from_camera`` takes camera coordinates to the world's. The world has x right, y down, z forward; up is -y.
    The rig's centre is the mean of the camera positions, or of those that ``around`` names.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Bool, Float, Int, Num
from torch import Tensor

from sphericalvision.cameras.base import Camera, Projection, check_single
from sphericalvision.cameras.checks import (
    at_least_float32,
    check_image,
    check_poses,
    check_rotation,
    checked_size,
)
from sphericalvision.cameras.masks import is_usable, resized_mask, stack_masks
from sphericalvision.cameras.models.fisheye import FisheyeCamera
from sphericalvision.core import (
    ArgumentError,
    ArgumentTypeError,
    ShapeError,
    check_tensor,
    check_type,
    short_repr,
)
from sphericalvision.geometry import (
    directions_from_longitude_latitude,
    invert_transform,
    transform_from_axis_angle,
)
from sphericalvision.geometry.directions import has_numbers, holds
from sphericalvision.kernels import Operator, full_precision
from sphericalvision.shapes import check_shapes

FAR = 1000.0
"""Metres from the origin up to which float32 holds a position well."""


class CameraRig:
    """Ordered, named cameras and their poses.

    Args:
        cameras: a mapping from names to cameras, or a sequence, whose cameras are named ``cam1``, ``cam2``, ...
        world_from_camera: ``(*b, n, 4, 4)`` rigid transforms, metres; leading dimensions are a batch of rigs.
        masks: for some or all names, ``(*b, h, w)`` bool, True where the image is usable.
        around: names of cameras whose mean position is the centre, from which depth is measured; all when not given.
            Files do not hold it.
        origin: ``(*b, 3)`` metres, float64: a place near the cameras in a world whose own origin is far away, such as
            UTM's. All positions and points of the rig are as seen from there; what is written to files is in that
            world again. Zero when not given.

    Raises:
        ShapeError: if the poses do not fit the cameras, a mask its image, or the origin the poses.
        ArgumentError: if a pose is not finite or not rigid, or a mask or ``around`` has an unknown name.

    Examples:
        >>> rig = ring_rig(4, radius=0.2)
        >>> rig
        CameraRig(cam1, cam2, cam3, cam4: 4 x FisheyeCamera, radius 0.200 m)
        >>> rig.center.abs().max() < 1e-6
        tensor(True)
    """

    def __init__(
        self,
        cameras: Mapping[str, Camera] | Sequence[Camera],
        world_from_camera: Float[Tensor, "*rigs n 4 4"],
        masks: Mapping[str, Bool[Tensor, " ..."]] | None = None,
        around: Sequence[str] | None = None,
        origin: Float[Tensor, "*rigs 3"] | None = None,
    ) -> None:
        if isinstance(cameras, Camera):
            raise ArgumentTypeError(
                "cameras: expected a list or a dict of cameras, got a single one; write [camera]"
            )
        named = cameras if isinstance(cameras, Mapping) else {f"cam{i + 1}": c for i, c in enumerate(cameras)}
        self.cameras: dict[str, Camera] = dict(named)
        self.world_from_camera = world_from_camera
        self.masks: dict[str, Tensor] = dict(masks or {})
        self.around = None if around is None else list(around)
        self._check_cameras()
        lead = (*world_from_camera.shape[:-3], 3)
        self.origin: Tensor = (
            world_from_camera.new_zeros(lead, dtype=torch.float64) if origin is None else origin
        )
        if tuple(self.origin.shape) != lead or self.origin.dtype != torch.float64:
            raise ShapeError(
                f"origin: expected float64 {lead}, got {self.origin.dtype} {tuple(self.origin.shape)}"
            )

    def _check_cameras(self) -> None:
        """Raise unless poses and masks are those of the cameras, and names are known."""
        for name, camera in self.cameras.items():
            check_type(f"cameras[{name!r}]", camera, Camera, "read_camera reads one")
        check_poses(self.names, self.world_from_camera)
        for name, mask in self.masks.items():
            check_tensor(f"masks[{name!r}]", mask, "(*b, h, w)")
            if name not in self.cameras:
                raise ArgumentError(f"masks: expected names among {', '.join(self.names)}, got {name!r}")
            if tuple(mask.shape[-2:]) != self.cameras[name].image_size:
                raise ShapeError(
                    f"masks[{name!r}]: expected shape {self.cameras[name].image_size}, got {tuple(mask.shape)}"
                )
            if mask.dtype != torch.bool:
                raise ArgumentError(
                    f"masks[{name!r}]: expected bool, True where the image is usable, got {mask.dtype}; "
                    "mask > 0 makes one"
                )
        if self.around is not None and not set() < set(self.around) <= set(self.cameras):
            raise ArgumentError(f"around: expected names among {', '.join(self.names)}, got {self.around}")

    @property
    def names(self) -> list[str]:
        """Names of the cameras, in order."""
        return list(self.cameras)

    def __len__(self) -> int:
        return len(self.cameras)

    @property
    def batch_shape(self) -> tuple[int, ...]:
        """The leading dimensions ``*b`` of the poses: none for a single rig."""
        return tuple(self.world_from_camera.shape[:-3])

    @property
    def camera_from_world(self) -> Float[Tensor, "*rigs n 4 4"]:
        """Inverse poses ``(*b, n, 4, 4)``."""
        return invert_transform(self.world_from_camera)

    @property
    def positions(self) -> Float[Tensor, "*rigs n 3"]:
        """Where the cameras are ``(*b, n, 3)``, metres."""
        return self.world_from_camera[..., :3, 3]

    @property
    def center(self) -> Float[Tensor, "*rigs 3"]:
        """Mean position of the cameras, or of those in ``around`` ``(*b, 3)``, metres."""
        if self.around is None:
            return self.positions.mean(-2)
        return self.positions[..., [self.names.index(name) for name in self.around], :].mean(-2)

    @property
    def radius(self) -> Float[Tensor, "*rigs"]:
        """Mean distance of the cameras from the centre ``(*b)``, metres."""
        return (self.positions - self.center[..., None, :]).norm(dim=-1).mean(-1)

    @property
    def baselines(self) -> Float[Tensor, "*rigs n n"]:
        """Distances between the cameras ``(*b, n, n)``, metres.

        Examples:
            >>> ring_rig(4, radius=0.2).baselines[0, 2]  # front to back
            tensor(0.4000)
        """
        return (self.positions.unsqueeze(-2) - self.positions.unsqueeze(-3)).norm(dim=-1)

    @property
    def axes(self) -> Float[Tensor, "*rigs n 3"]:
        """Optical axes in the world ``(*b, n, 3)``, unit length."""
        return self.world_from_camera[..., :3, 2]

    @property
    def max_angles(self) -> Float[Tensor, "*rigs n"]:
        """Half fields of view ``(*b, n)``, radians."""
        poses = self.world_from_camera
        angles = (camera.max_angle.to(poses).expand(poses.shape[:-3]) for camera in self.cameras.values())
        return torch.stack(list(angles), -1)

    def to(
        self, device: torch.device | str | None = None, dtype: torch.dtype | None = None, **_: object
    ) -> CameraRig:
        """The rig with all its tensors on another device or of another floating point type.

        Of positions that float32 would round by more than 0.06 mm, those beyond a kilometre, an ``origin`` near the
        cameras is subtracted before.
        """
        if isinstance(device, torch.dtype):
            device, dtype = None, device
        cameras = {name: camera.to(device, dtype) for name, camera in self.cameras.items()}
        masks = {name: mask.to(device) for name, mask in self.masks.items()}
        local = self._from_near_by() if dtype == torch.float32 else self
        poses = local.world_from_camera.to(device, dtype)
        return self._of(cameras=cameras, world_from_camera=poses, masks=masks, origin=local.origin.to(device))

    def _from_near_by(self) -> CameraRig:
        """The rig with poses as seen from a place near the cameras, whole metres, if they are far from the origin."""
        positions = self.positions.detach()
        if self.world_from_camera.dtype != torch.float64 or not has_numbers(positions):
            return self
        if not positions.numel() or float(positions.abs().max()) <= FAR:
            return self
        center = positions.mean(-2).round()
        poses = self.world_from_camera.clone()
        poses[..., :3, 3] -= center[..., None, :]
        return self.replaced(world_from_camera=poses, origin=self.origin + center)

    def in_world(self) -> CameraRig:
        """The rig with poses in the world of its file, float64 if these are not what they are here.

        Examples:
            >>> far = ring_rig(2).replaced(origin=torch.tensor([4e5, 0.0, 5e6]).double())
            >>> far.positions[0].tolist()[:2], far.in_world().positions[0].tolist()[:2]
            ([0.0, 0.0], [400000.0, 0.0])
        """
        if not self.origin.any():
            return self
        poses = self.world_from_camera.double().clone()
        # Rounded rotations are no longer quite orthonormal, which counts where inverse poses are written.
        left, _, right = torch.linalg.svd(poses[..., :3, :3])
        poses[..., :3, :3] = left @ right
        poses[..., :3, 3] += self.origin[..., None, :]
        return self.replaced(world_from_camera=poses, origin=torch.zeros_like(self.origin))

    def replaced(
        self,
        cameras: Mapping[str, Camera] | None = None,
        world_from_camera: Float[Tensor, "*rigs n 4 4"] | None = None,
        masks: Mapping[str, Bool[Tensor, " ..."]] | None = None,
        origin: Float[Tensor, "*rigs 3"] | None = None,
    ) -> CameraRig:
        """The rig with other cameras of the same names, other poses, masks or origin; all else stays.

        Examples:
            >>> rig = ring_rig(2)
            >>> rig.replaced(world_from_camera=rig.camera_from_world).positions[0].abs()
            tensor([0.0000, 0.0000, 0.2000])
        """
        return CameraRig(
            self.cameras if cameras is None else cameras,
            self.world_from_camera if world_from_camera is None else world_from_camera,
            self.masks if masks is None else masks,
            self.around,
            self.origin if origin is None else origin,
        )

    def _of(self, **values: Any) -> CameraRig:
        """The rig of this one's values, checked when it was made: on a device each check would be waited for."""
        rig = copy.copy(self)
        vars(rig).update(values)
        return rig

    def subset(self, which: Sequence[str | int]) -> CameraRig:
        """The rig with only these cameras, by name or index, in this order.

        Examples:
            >>> ring_rig(4).subset(["cam3", 0]).names
            ['cam3', 'cam1']
        """
        names = self.names
        for key in which:
            exists = key in names if isinstance(key, str) else -len(names) <= key < len(names)
            if not exists:
                raise ArgumentError(
                    f"cameras: expected names among {', '.join(names)} or indices, got {key!r}"
                )
        index = [names.index(key) if isinstance(key, str) else range(len(names))[key] for key in which]
        if not index or len(set(index)) != len(index):
            raise ArgumentError(f"cameras: expected each camera once and at least one, got {list(which)}")
        chosen = [names[i] for i in index]
        masks = {name: self.masks[name] for name in chosen if name in self.masks}
        around = [name for name in self.around or () if name in chosen] or None
        poses = self.world_from_camera[..., index, :, :]
        return CameraRig({n: self.cameras[n] for n in chosen}, poses, masks, around, self.origin)

    def permuted(self, order: Sequence[int] | Int[Tensor, " n"]) -> CameraRig:
        """The rig with its cameras in another order, a permutation of 0 ... n - 1."""
        order = [int(i) for i in order]
        if sorted(order) != list(range(len(self))):
            raise ArgumentError(f"order: expected a permutation of 0 to {len(self) - 1}, got {order}")
        return self.subset(order)

    @full_precision
    def rotated(
        self, tilt: float | Float[Tensor, " ..."] = 0.0, rotation: Float[Tensor, "*rigs 3 3"] | None = None
    ) -> CameraRig:
        """The rig with other orientations; positions of tilted cameras stay where they are.

        Args:
            tilt: radians by which every camera looks further down, about its own x axis (the paper's rotated rigs);
                a number, or an angle for each camera, ``(*b, n)``.
            rotation: ``(*b, 3, 3)`` turns the whole rig about the world's origin, after the tilt.

        Raises:
            ArgumentError: a tilt beyond ±2π, or what is no rotation.

        References:
            Komatsu et al. (2020), section IV-C.

        Examples:
            >>> ring_rig(4).rotated(tilt=math.radians(30)).axes[0]  # the front camera looks 30° down, and down is +y
            tensor([0.0000, 0.5000, 0.8660])
        """
        if isinstance(tilt, Tensor) and tilt.shape[-2:] == (3, 3):
            raise ArgumentError(
                "tilt: expected angles in radians, got 3 x 3 matrices; pass them as rotation=..."
            )
        if isinstance(tilt, int | float) and abs(tilt) > 2 * math.pi:
            raise ArgumentError(f"tilt: expected radians within ±2π, got {tilt:g}; are these degrees?")
        poses = self.world_from_camera
        angle = torch.as_tensor(tilt, dtype=poses.dtype, device=poses.device)
        zero = torch.zeros_like(angle)
        down = transform_from_axis_angle(torch.stack((-angle, zero, zero), -1), poses.new_zeros(3))
        poses, origin = poses @ down, self.origin
        if rotation is not None:
            check_rotation("rotation", rotation)
            transform = torch.eye(4, dtype=poses.dtype, device=poses.device).repeat(
                *rotation.shape[:-2], 1, 1
            )
            transform[..., :3, :3] = rotation.to(poses)
            poses = transform[..., None, :, :] @ poses
            origin = (rotation.to(origin) @ origin[..., None]).squeeze(-1)
        return self.replaced(world_from_camera=poses, origin=origin)

    def resized(self, image_size: Sequence[int] | Mapping[str, Sequence[int]]) -> CameraRig:
        """The rig of the same images after they are resized; every ray stays as it is.

        A pixel of a resized mask is usable only if all the pixels that it covers are.

        Args:
            image_size: (height, width) for all cameras, or for some of them by name.

        Raises:
            ArgumentError: an unknown name.

        Examples:
            >>> ring_rig(4, image_size=(768, 800)).resized((384, 400)).cameras["cam1"].image_size
            (384, 400)
        """
        sizes = dict(image_size) if isinstance(image_size, Mapping) else dict.fromkeys(self.names, image_size)
        if unknown := [name for name in sizes if name not in self.cameras]:
            raise ArgumentError(
                f"image_size: expected names among {', '.join(self.names)}, got {unknown[0]!r}"
            )
        sized = {name: (id(self.cameras[name]), checked_size(size)) for name, size in sizes.items()}
        resized = {  # one camera that stands in several places stays one
            place: self.cameras[name].resized(place[1])
            for place, name in {place: name for name, place in sized.items()}.items()
        }
        cameras = {n: resized[sized[n]] if n in sized else c for n, c in self.cameras.items()}
        masks = {name: resized_mask(mask, cameras[name].image_size) for name, mask in self.masks.items()}
        return self.replaced(cameras, masks=masks)

    def scaled(self, factor: float) -> CameraRig:
        """The rig with all positions multiplied by ``factor``; depths seen by it scale alike."""
        poses = self.world_from_camera.clone()
        poses[..., :3, 3] *= factor
        return self.replaced(world_from_camera=poses, origin=self.origin * factor)

    def select(self, index: int) -> CameraRig:
        """One rig of a batch."""
        if self.world_from_camera.ndim < 4:
            raise ArgumentError("select: this rig has no batch dimension; its poses are (n, 4, 4)")
        cameras = {n: c.select(index) if c.batch_shape else c for n, c in self.cameras.items()}
        masks = {name: mask[index] if mask.ndim > 2 else mask for name, mask in self.masks.items()}
        poses, origin = self.world_from_camera[index], self.origin[index]
        return self._of(cameras=cameras, world_from_camera=poses, masks=masks, origin=origin)

    @staticmethod
    def stack(rigs: Sequence[CameraRig]) -> CameraRig:
        """One rig with poses ``(B, n, 4, 4)``; camera parameters and masks are shared where equal.

        Raises:
            ArgumentError: if the rigs differ in names, models or image sizes.

        Examples:
            >>> CameraRig.stack([ring_rig(4), ring_rig(4, radius=0.1)]).center.shape
            torch.Size([2, 3])
        """
        if not rigs:
            raise ArgumentError("rigs: expected at least one rig, got none")
        first = rigs[0]
        for rig in rigs[1:]:
            if rig.names != first.names:
                raise ArgumentError(
                    f"rigs: expected the same camera names, got {first.names} and {rig.names}"
                )
            if rig.around != first.around:
                raise ArgumentError(f"rigs: expected the same around, got {first.around} and {rig.around}")
        cameras = {name: _stack_cameras(name, [rig.cameras[name] for rig in rigs]) for name in first.names}
        poses = torch.stack([rig.world_from_camera for rig in rigs])
        origin = torch.stack([rig.origin for rig in rigs])
        return CameraRig(
            cameras, poses, stack_masks(first.cameras, [rig.masks for rig in rigs]), first.around, origin
        )

    @check_shapes
    def project(self, points: Float[Tensor, "*rigs P 3"]) -> Projection:
        """Pixels ``(*b, n, P, 2)`` of points ``(P, 3)`` of the world, in metres, and which cameras see them.

        Valid ``(*b, n, P)`` means: within the field of view, on the image, and all the pixels around are usable by the
        mask. What stands in the way is not known. Points of a batch of rigs may be ``(*b, P, 3)``.

        Examples:
            >>> pixels, valid = ring_rig(4).project(torch.tensor([[0.0, 0.0, 2.0]]))  # in front of the first camera
            >>> pixels[0, 0].tolist(), valid[:, 0].tolist()
            ([399.5, 383.5], [True, True, False, True])
        """
        points = at_least_float32("points", points)
        positions = self.positions.to(points)
        return self._project_rays([points - positions[..., i, None, :] for i in range(len(self))])

    @check_shapes
    def project_along(
        self, directions: Float[Tensor, "V 3"], inverse_depths: Num[Tensor, " ..."]
    ) -> Projection:
        """Pixels ``(*b, n, N, V, 2)`` of the points at ``inverse_depths`` ``(N,)`` along ``directions`` ``(V, 3)``.

        As ``project`` of ``rig.center + directions / inverse_depths``, but exact out to infinity, where the inverse
        depth is 0: a camera at c sees the point in the direction d + w · (center − c).

        Args:
            directions: unit vectors in the world.
            inverse_depths: 1/m; ``(*b, N, V)`` for inverse depths of each direction's own.
        """
        directions = at_least_float32("directions", directions)
        values = inverse_depths.to(directions)
        values = values[:, None] if values.ndim == 1 else values
        if values.ndim < 2 or values.shape[-1] not in (1, len(directions)):
            raise ShapeError(
                f"inverse_depths: expected (N,) or (*b, N, {len(directions)}), got {tuple(inverse_depths.shape)}"
            )
        offsets = (self.center.unsqueeze(-2) - self.positions).to(directions)
        rays = [directions + values.unsqueeze(-1) * offsets[..., i, None, None, :] for i in range(len(self))]
        pixels, valid = self._project_rays([ray.flatten(-3, -2) for ray in rays])
        shape = rays[0].shape[-3:-1]
        return Projection(pixels.unflatten(-2, shape), valid.unflatten(-1, shape))

    def points_seen(
        self, directions: Float[Tensor, "V 3"], inverse_depths: Float[Tensor, " ..."]
    ) -> Bool[Tensor, "*rigs n N V"]:
        """Which cameras see the points at ``inverse_depths`` along ``directions``: bool ``(*b, n, N, V)``.

        Fields of view, image borders and masks count; what stands in the way is not known.

        Args:
            directions: ``(V, 3)`` unit vectors in the world, from the rig's centre.
            inverse_depths: ``(N,)`` in 1/m, 0 is infinity; ``(*b, N, V)`` for those of each direction's own.

        Raises:
            ArgumentError: an inverse depth is negative or NaN.

        Examples:
            >>> seen = ring_rig(4).points_seen(torch.tensor([[0.0, 0.0, 1.0]]), torch.tensor([0.0, 1.0]))
            >>> seen[..., 0].tolist()  # the cameras that look forward, right, back and left; far away and at 1 m
            [[True, True], [True, True], [False, False], [True, True]]
        """
        if not holds(inverse_depths >= 0):
            raise ArgumentError(
                f"inverse_depths: expected 1/m, 0 (infinity) or more, got {inverse_depths.min().item():g}"
            )
        return self.project_along(directions, inverse_depths).valid

    @full_precision
    def _project_rays(self, rays: Sequence[Tensor]) -> Projection:
        """Pixels of the rays ``(*b, P, 3)`` from each camera, whose coordinates are turned like the world's."""
        cameras = list(self.cameras.values())
        rotations = self.world_from_camera[..., :3, :3].to(rays[0]).unbind(-3)
        rays = [ray @ rotation for ray, rotation in zip(rays, rotations, strict=True)]
        projections = _project_cameras(rays, cameras)
        pixels, valid = [one.pixels for one in projections], [one.valid for one in projections]
        for index, name in enumerate(self.names):
            if name in self.masks:
                coords = pixels[index].where(valid[index].unsqueeze(-1), 0.0)
                valid[index] = valid[index] & is_usable(cameras[index], self.masks[name], coords)
        return Projection(torch.stack(pixels, -3), torch.stack(valid, -2))

    def to_yaml(self, path: str | Path) -> None:
        """Write the rig as this package's own YAML, which ``read_rig`` reads; masks become images beside it.

        Raises:
            ArgumentError: the rig is a batch, or a camera of one's own model is not registered, so that it could not
                be read back.
        """
        # Files and images, which a network does not need
        from sphericalvision.cameras.native_files import write_rig

        check_single(self)
        write_rig(path, self.cameras, self.in_world().world_from_camera, self.masks)

    def __repr__(self) -> str:
        kinds = {type(camera).__name__ for camera in self.cameras.values()}
        radius = f"radius {float(self.radius.mean()):.3f} m"
        return f"CameraRig({', '.join(self.names)}: {len(self)} x {'/'.join(sorted(kinds))}, {radius})"


def _project_each(rays: list[Tensor], cameras: list[Camera]) -> list[Projection]:
    return [camera.project(ray) for camera, ray in zip(cameras, rays, strict=True)]


def _project_together(rays: list[Tensor], cameras: list[Camera]) -> list[Projection]:
    """One batch of cameras that are alike, in place of as many operators for each."""
    if any(camera._signature() != cameras[0]._signature() for camera in cameras):
        return NotImplemented
    together = type(cameras[0]).stack(cameras).project(torch.stack(rays))
    return [Projection(*one) for one in zip(*together, strict=True)]


_project_cameras = Operator(_project_each, fused=_project_together)


def ring_rig(
    num_cameras: int = 4,
    radius: float = 0.2,
    image_size: Sequence[int] = (768, 800),
    field_of_view: float = math.radians(220),
    projection: str = "equidistant",
) -> CameraRig:
    """Equal fisheyes on a horizontal ring that look outwards: the first forward, the others clockwise from above.

    The default is like the rig of OmniThings: front, right, back and left at 0.2 m, 220°.

    Args:
        num_cameras: 2 or more.
        radius: metres from the world's origin to each camera.
        image_size: (height, width) in pixels; the image circle fills the shorter side.
        field_of_view: full angle in radians.
        projection: of the fisheye.

    Examples:
        >>> ring_rig(4).world_from_camera[1, :3, 3]  # the second camera stands to the right, on +x
        tensor([0.2000, 0.0000, 0.0000])
    """
    if isinstance(num_cameras, bool) or not isinstance(num_cameras, int) or num_cameras < 2:
        raise ArgumentError(
            f"num_cameras: expected a whole number of 2 or more, got {short_repr(num_cameras)}"
        )
    if not isinstance(radius, int | float) or not 0 < radius < math.inf:
        raise ArgumentError(f"radius: expected metres above 0, got {short_repr(radius)}")
    camera = FisheyeCamera.from_field_of_view(image_size, field_of_view, projection)
    longitude = torch.arange(num_cameras, dtype=torch.float64) * (2 * math.pi / num_cameras)
    zero = torch.zeros_like(longitude)
    position = radius * directions_from_longitude_latitude(longitude, zero)
    poses = transform_from_axis_angle(torch.stack((zero, longitude, zero), -1), position)
    exact = poses.round(decimals=12) + 0.0  # quarter turns without rounding, and no negative zeros
    return CameraRig([camera] * num_cameras, exact.to(torch.get_default_dtype()))


def check_images_of(
    rig: CameraRig, images: Mapping[str, Tensor], name: str = "images", shape: str = "(*b, c, h, w)"
) -> None:
    """Raise ``ArgumentError`` unless there is an image of each camera, and ``ShapeError`` for one of another size."""
    if set(images) != set(rig.cameras):
        raise ArgumentError(
            f"{name}: expected one for each of {', '.join(rig.names)}, got {', '.join(map(str, images))}"
        )
    for camera_name, camera in rig.cameras.items():
        check_image(f"{name}[{camera_name!r}]", images[camera_name], camera.image_size, shape)


def _stack_cameras(name: str, cameras: list[Camera]) -> Camera:
    first = cameras[0]
    if all(camera is first or camera.equals(first) for camera in cameras[1:]):
        return first
    try:
        return type(first).stack(cameras)
    except ArgumentError as error:
        raise ArgumentError(f"rigs: camera {name} cannot be stacked: {error}") from error
