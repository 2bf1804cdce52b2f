# SPDX-License-Identifier: Apache-2.0
"""Poses of a camera or a rig that moves: windows of them are rigs, whose baselines are the way that it went."""

from __future__ import annotations

import re
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sphericalvision.cameras.base import Camera
from sphericalvision.cameras.checks import PLAUSIBLE, check_poses
from sphericalvision.cameras.rig import CameraRig
from sphericalvision.core import ArgumentError, check_choice
from sphericalvision.io.times import SAME_TIME, SINCE_1970, are_counts, nearest_in_time, seconds
from sphericalvision.kernels import full_precision

UPS = ("-y", "y", "z", "camera")
"""What may point up in a file of poses."""


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Poses of one camera, or of the frame that the poses of a rig's cameras refer to, one after the other.

    Attributes:
        names: of the poses: their time stamps, their rows counted from 0, or the names of images.
        world_from_camera: ``(n, 4, 4)`` rigid transforms, metres, float64; of a rig that is world from rig.
        names_are_rows: the names are rows counted from 0, which the file does not state.

    Raises:
        ShapeError: there are not as many poses as names.
        ArgumentError: a pose is not finite or not rigid.

    Examples:
        >>> poses = torch.eye(4).repeat(9, 1, 1)
        >>> poses[:, 2, 3] = torch.arange(9) / 10  # 10 cm forward from image to image
        >>> trajectory = Trajectory([f"{k / 10:.1f}" for k in range(9)], poses)
        >>> trajectory.windows(3, spacing=0.2)
        [[0, 2, 4], [2, 4, 6], [4, 6, 8]]
        >>> from sphericalvision.cameras import EquirectangularCamera
        >>> trajectory.rig(EquirectangularCamera((40, 80)), [2, 4, 6])
        CameraRig(0.2, 0.4, 0.6: 3 x EquirectangularCamera, radius 0.133 m)
    """

    names: Sequence[str]
    world_from_camera: Float[Tensor, "n 4 4"]
    names_are_rows: bool = False

    def __post_init__(self) -> None:
        check_poses(list(self.names), self.world_from_camera)

    def __len__(self) -> int:
        return len(self.names)

    @property
    def positions(self) -> Float[Tensor, "n 3"]:
        """Where the camera or the rig was ``(n, 3)``, metres."""
        return self.world_from_camera[:, :3, 3]

    def windows(self, size: int = 3, spacing: float = 0.0) -> list[list[int]]:
        """Return the numbers of the poses of each window: so many, each ``spacing`` away from the one before.

        Poses that are nearer than ``spacing`` to the last one taken are passed over, so that a camera that stands still
        makes no windows. Neighbouring windows share all but one pose.

        Args:
            size: poses in a window, two or more.
            spacing: metres, 0 for all poses.

        Raises:
            ArgumentError: there is no window.
        """
        if size < 2 or spacing < 0:
            raise ArgumentError(
                f"size, spacing: expected 2 or more and metres of 0 or more, got {size} and {spacing}"
            )
        if len(self) < size:
            raise ArgumentError(f"size: expected {size} poses or more for a window, got {len(self)}")
        positions, taken = self.positions, [0]
        for number in range(1, len(self)):
            if float((positions[number] - positions[taken[-1]]).norm()) >= spacing * (1 - 1e-6):
                taken.append(number)
        if len(taken) < size:
            raise ArgumentError(
                f"spacing: expected {size} poses {spacing:g} m apart or more, but only {len(taken)} of {len(self)} are "
                "that far from each other; try a smaller spacing or window"
            )
        return [taken[first : first + size] for first in range(len(taken) - size + 1)]

    @full_precision
    def rig(
        self, camera: Camera | CameraRig, numbers: Sequence[int], mask: Bool[Tensor, "h w"] | None = None
    ) -> CameraRig:
        """Return images at some of the poses as a rig.

        Its cameras are called as the poses are; of a rig of several cameras ``front@12.30`` is what ``front`` was at
        the pose ``12.30``, and the centre is where the rig's was at the pose in the middle of ``numbers``.
        If the world's origin is far away, the rig has an ``origin`` near by; see ``CameraRig``.

        Args:
            camera: the one that moved, or the rig, with its masks.
            numbers: which poses, as ``windows`` gives them.
            mask: ``(h, w)`` of one camera, True where its images are usable: not on what carries it.

        Examples:
            >>> from sphericalvision.cameras import ring_rig
            >>> poses = torch.eye(4).repeat(3, 1, 1)
            >>> poses[:, 0, 3] = torch.tensor([0.0, 1.0, 5.0])
            >>> rig = Trajectory(["a", "b", "c"], poses).rig(ring_rig(2), [0, 1, 2])
            >>> rig.names[1:4], rig.center
            (['cam2@a', 'cam1@b', 'cam2@b'], tensor([1., 0., 0.]))
        """
        if not numbers or not all(0 <= number < len(self) for number in numbers):
            raise ArgumentError(f"numbers: expected some of 0 to {len(self) - 1}, got {list(numbers)}")
        if isinstance(camera, Camera):
            camera = CameraRig({"": camera}, torch.eye(4)[None], None if mask is None else {"": mask})
        elif mask is not None:
            raise ArgumentError("mask: a rig has masks of its own, CameraRig(cameras, poses, masks)")

        def called(name: str, number: int) -> str:
            return f"{name}@{self.names[number]}" if len(camera) > 1 else self.names[number]

        views = {called(name, number): name for number in numbers for name in camera.names}
        poses = self.world_from_camera[list(numbers), None] @ camera.in_world().world_from_camera.to(
            self.world_from_camera
        )
        center = numbers[len(numbers) // 2]
        rig = CameraRig(
            {view: camera.cameras[name] for view, name in views.items()},
            poses.flatten(0, 1),
            {view: camera.masks[name] for view, name in views.items() if name in camera.masks},
            [called(name, center) for name in camera.around or camera.names] if len(camera) > 1 else None,
        ).to(dtype=torch.get_default_dtype())
        if len(numbers) > 1 and not PLAUSIBLE[0] <= (radius := float(rig.radius)) <= PLAUSIBLE[1]:
            warnings.warn(
                f"poses: images of a window are {radius:.1g} m from their centre on average, which is implausible "
                "(expected 5 mm to 5 m). Trajectories are in metres: check their unit, and spacing=",
                stacklevel=3,
            )
        return rig

    @full_precision
    def turned(self, up: str) -> Trajectory:
        """Return the poses in a world whose y points down, as everywhere in this package.

        Args:
            up: what points up now: the axis ``"-y"`` (nothing changes), ``"y"`` or ``"z"``; or ``"camera"``, what is up
                in the images, or of the rig, on average.

        Examples:
            >>> pose = torch.eye(4)[None]
            >>> pose[0, :3, 3] = torch.tensor([1.0, 2.0, 3.0])
            >>> Trajectory(["0"], pose).turned("z").positions  # 3 m high, now -y
            tensor([[ 1., -3.,  2.]])
        """
        rotation = upright_turn(up, self.world_from_camera)
        return replace(self, world_from_camera=rotation @ self.world_from_camera)

    def of_images(self, images: Sequence[str], times: Sequence[float] | None = None) -> Trajectory:
        """Return the poses of images, called as the images are; images without a pose are left out.

        An image's pose is the one at its time, at most 20 ms away, or the one of its name. Names that are numbers count
        where every image has a pose of its number, or every pose an image. Where nothing of this tells and there are
        as many images as poses, they belong together in their order, unless both have times since 1970.

        Args:
            images: names of the images in their order, without suffix: ``"000012"``, or times as ``io.times.seconds``
                reads them: ``"1305031102.175304"`` (seconds), ``"1403636579763555584"`` (nanoseconds).
            times: of the images in seconds, where their names do not tell.

        Raises:
            ArgumentError: nothing tells which pose is whose.

        Examples:
            >>> three = Trajectory(["0.00", "0.05", "0.10"], torch.eye(4).repeat(3, 1, 1))
            >>> list(three.of_images(["a", "b", "c"]).names), list(three.of_images(["0.099", "0.2"]).names)
            (['a', 'b', 'c'], ['0.099'])
        """
        matches = self.matches(images, times)
        return Trajectory(list(matches), self.world_from_camera[list(matches.values())])

    def matches(self, images: Sequence[str], times: Sequence[float] | None = None) -> dict[str, int]:
        """Return which pose is whose, as ``of_images`` takes them: image -> place of its pose."""
        matches = self._by_time(images, times) or self._by_name(images)
        clocks = (seconds(images), seconds(self.names))
        have_times = all(time is not None and time >= SINCE_1970 for clock in clocks for time in clock)
        if not matches and len(images) == len(self) and not have_times:
            matches = {image: number for number, image in enumerate(images)}
        if not matches:
            raise ArgumentError(
                f"images: which pose is whose? There are {len(images)} images ({_first(images)}) and {len(self)} poses "
                f"({_first(self.names)}{', rows of the file' if self.names_are_rows else ''}). Expected equally many, "
                f"images called as the poses, or times at most {SAME_TIME * 1000:.0f} ms apart"
            )
        return matches

    def _by_time(self, images: Sequence[str], times: Sequence[float] | None) -> dict[str, int]:
        """Image -> the pose nearest in time, where both have times; a pose is of the image nearest to it."""
        if are_counts(self.names) or (times is None and are_counts(images)):
            return {}
        moments, poses = seconds(images) if times is None else times, seconds(self.names)
        nearest, first = nearest_in_time(moments, poses), nearest_in_time(poses, moments)
        return {images[k]: n for k, n in enumerate(nearest) if n is not None and first[n] == k}

    def _by_name(self, images: Sequence[str]) -> dict[str, int]:
        """Image -> the pose of its name, or of its number where all of the fewer side belong to one of the other.

        Numbers are weak names: images may be counted from 1 where poses are counted from 0. They say which is whose
        only where none is left over; rows, which no file states and which may be keyframes, only of images that are
        counted from 0, too, and have a row each.
        """
        if not (are_counts(images) and are_counts([_whole(name) for name in self.names])):
            named = {name: place for place, name in enumerate(self.names)}
            return {image: named[image] for image in images if image in named}
        indices = {int(_whole(name)): place for place, name in enumerate(self.names)}
        numbers = {image: int(image) for image in images}
        matches = {image: indices[number] for image, number in numbers.items() if number in indices}
        is_whole = len(matches) == (len(images) if self.names_are_rows else min(len(images), len(self)))
        return matches if is_whole and (0 in numbers.values() or not self.names_are_rows) else {}


def upright_turn(up: str, poses: Float[Tensor, "n 4 4"]) -> Float[Tensor, "4 4"]:
    """The rotation ``(4, 4)`` by the smallest angle into a world whose y points down.

    Args:
        up: what points up now, as ``Trajectory.turned`` has it.
        poses: ``(n, 4, 4)`` of cameras, whose mean says what is up for ``"camera"``.
    """
    check_choice("up", up, UPS)
    axes = {"-y": [0.0, -1.0, 0.0], "y": [0.0, 1.0, 0.0], "z": [0.0, 0.0, 1.0]}
    upwards = -poses[:, :3, 1].mean(0) if up == "camera" else poses.new_tensor(axes[up])
    transform = torch.eye(4).to(poses)
    transform[:3, :3] = _shortest_turn(torch.nn.functional.normalize(upwards, dim=0))
    return transform


def _whole(name: str) -> str:
    """A number with decimals that are all zero, without them."""
    return re.sub(r"\.0*$", "", name)


def _first(names: Sequence[str]) -> str:
    return ", ".join(names[:2]) + (", ..." if len(names) > 2 else "")


def _shortest_turn(upwards: Tensor) -> Tensor:
    """The rotation ``(3, 3)`` by the smallest angle that takes a unit vector to (0, -1, 0)."""
    cosine = -upwards[1]
    if cosine < -1 + max(1e-9, 4 * torch.finfo(upwards.dtype).eps):  # half a turn, about x
        return torch.diag(upwards.new_tensor([1.0, -1.0, -1.0]))
    x, _, z = upwards
    zero = torch.zeros_like(x)
    # Of the cross product of both vectors, (z, 0, -x).
    cross = torch.stack((zero, x, zero, -x, zero, -z, zero, z, zero)).view(3, 3)
    return torch.eye(3).to(upwards) + cross + cross @ cross / (1 + cosine)
