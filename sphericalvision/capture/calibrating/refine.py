# SPDX-License-Identifier: Apache-2.0
"""Bundle adjustment: intrinsics and poses that bring the projections of a known object to where it was seen.

Convention:
    ``points`` (m, 3) are those of one rigid object, a checkerboard say, in its own frame; it is seen n times, each time
    somewhere else. Pixels of points that were not seen may hold anything.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sphericalvision.cameras.base import Camera, check_single
from sphericalvision.cameras.fitting import fit_choices
from sphericalvision.cameras.models.ocam import OCamCamera
from sphericalvision.cameras.models.ocam_polynomials import fit_inverse_polynomial
from sphericalvision.cameras.rig import CameraRig
from sphericalvision.capture.calibrating.board_pose import pose_from_directions
from sphericalvision.capture.calibrating.turns import rotations
from sphericalvision.core import ArgumentError, ShapeError
from sphericalvision.geometry import invert_transform, transform_points
from sphericalvision.geometry.least_squares import solve_least_squares
from sphericalvision.shapes import check_shapes

FEWEST = 6
"""Seen points of the object at which a view counts."""


class RefinedCamera(NamedTuple):
    """A camera with better intrinsics, and how well they explain what was seen."""

    camera: Camera
    camera_from_points: Float[Tensor, "n 4 4"]
    """Where the object stood each time."""
    residuals: Float[Tensor, "n m 2"]
    """Projection minus pixel; 0 where not seen."""
    rms_error: float
    """Root mean square distance in pixels over all points seen."""


class RefinedRig(NamedTuple):
    """A rig with better poses, and how well they explain what was seen."""

    rig: CameraRig
    world_from_points: Float[Tensor, "n 4 4"]
    """Where the object stood each time."""
    residuals: Float[Tensor, "n cameras m 2"]
    """Projection minus pixel; 0 where not seen."""
    rms_error: float
    """Root mean square distance in pixels over all points seen."""


@check_shapes
def refine(
    camera: Camera,
    points: Float[Tensor, "m 3"],
    pixels: Float[Tensor, "n m 2"],
    seen: Bool[Tensor, "n m"] | None = None,
    *,
    fixed: Sequence[str] = (),
) -> RefinedCamera:
    """The camera whose intrinsics explain ``pixels`` (n, m, 2) of an object's ``points`` (m, 3) best.

    Levenberg-Marquardt in float64 over the intrinsics and one pose of the object for each of n views. It starts from
    ``camera`` and from poses by a linear method, so ``camera`` must be roughly right: a few degrees at the edge.

    Args:
        camera: a single camera of any model with intrinsics.
        points: (m, 3) in the object's frame, metres; z = 0 for a board.
        pixels: (n, m, 2) as (u, v), where each point was found.
        seen: (n, m), which were; all by default. Views with fewer than six are left out.
        fixed: intrinsics that stay as they are, for instance ``("principal_point",)``.

    Raises:
        ArgumentError: no view has enough points, ``fixed`` names no intrinsic, or nothing is left to refine.
        ShapeError: the shapes do not fit.

    References:
        B. Triggs et al., "Bundle adjustment: a modern synthesis", Vision Algorithms (1999).

    Examples:
        >>> from sphericalvision.cameras import FisheyeCamera
        >>> from sphericalvision.geometry import transform_from_axis_angle
        >>> truth = FisheyeCamera("equidistant", torch.tensor([101.0, 102.0]).double(), [119.0, 121.0], (240, 240), 1.5)
        >>> board = torch.cartesian_prod(torch.arange(7.0), torch.arange(5.0), torch.zeros(1)).double() * 0.05
        >>> turns = torch.tensor([[0.0, 0.4, 0.1], [0.5, 0.0, 0.0], [0.1, -0.6, 0.3]]).double()
        >>> places = transform_from_axis_angle(turns, torch.tensor([[-0.2, -0.1, 0.2]]).double().expand(3, 3))
        >>> pixels = truth.project(transform_points(places, board)).pixels
        >>> guess = FisheyeCamera("equidistant", torch.tensor([110.0, 110.0]).double(), [119.5, 119.5], (240, 240), 1.5)
        >>> found = refine(guess, board, pixels)
        >>> found.camera.focal_length.round(decimals=6).tolist(), found.rms_error < 1e-6
        ([101.0, 102.0], True)
    """
    check_single(camera)
    names = _free_names(_started(camera), fixed)
    rig = CameraRig([camera], torch.eye(4).to(camera.max_angle)[None])
    seen = None if seen is None else seen[:, None]
    refined = refine_rig(rig, points, pixels[:, None], seen, intrinsics=names)
    (camera,) = refined.rig.cameras.values()
    return RefinedCamera(camera, refined.world_from_points, refined.residuals[:, 0], refined.rms_error)


@check_shapes
def refine_rig(
    rig: CameraRig,
    points: Float[Tensor, "m 3"],
    pixels: Float[Tensor, "n cameras m 2"],
    seen: Bool[Tensor, "n cameras m"] | None = None,
    *,
    intrinsics: Sequence[str] = (),
) -> RefinedRig:
    """The rig whose poses explain ``pixels`` (n, cameras, m, 2) of an object's ``points`` (m, 3) best.

    Like ``refine`` for all cameras at once. The first camera stays where it is, as everything could move together; each
    time the object should be seen by two cameras at least, and all cameras be tied to the first by such views.

    Args:
        rig: a single rig, roughly right.
        points: (m, 3) in the object's frame, metres, which set the scale; z = 0 for a board.
        pixels: (n, cameras, m, 2) as (u, v).
        seen: (n, cameras, m); all by default. Views of a camera with fewer than six points are left out.
        intrinsics: names of intrinsics to be refined, too, in the cameras that have them; by default none.

    Raises:
        ArgumentError: no view has enough points.
        ShapeError: the shapes do not fit.

    Examples:
        >>> from sphericalvision.cameras import ring_rig
        >>> from sphericalvision.geometry import transform_from_axis_angle
        >>> rig = ring_rig(2).to(torch.float64)
        >>> board = torch.cartesian_prod(torch.arange(5.0), torch.arange(4.0), torch.zeros(1)).double() * 0.1
        >>> places = torch.tensor([[1.0, -0.2, 0.0], [-1.1, 0.1, 0.1], [1.2, 0.2, -0.3]]).double()
        >>> turns = torch.tensor([[0.0, 1.5, 0.2], [0.3, -1.4, 0.0], [0.2, 1.2, 0.0]]).double()
        >>> boards = transform_from_axis_angle(turns, places)
        >>> where = transform_points(boards, board)
        >>> projection = rig.project(where.reshape(-1, 3))
        >>> pixels = projection.pixels.reshape(2, 3, -1, 2).movedim(0, 1)
        >>> seen = projection.valid.reshape(2, 3, -1).movedim(0, 1)
        >>> knock = transform_from_axis_angle(torch.tensor([0.0, 0.009, 0.0]).double(), torch.zeros(3).double())
        >>> knocked = CameraRig(rig.cameras, torch.stack((rig.world_from_camera[0], rig.world_from_camera[1] @ knock)))
        >>> found = refine_rig(knocked, board, pixels, seen)
        >>> bool((found.rig.world_from_camera - rig.world_from_camera).abs().max() < 1e-6)
        True
    """
    check_single(rig)
    names = [
        [name for name in refinable_intrinsics(camera) if name in intrinsics]
        for camera in rig.cameras.values()
    ]
    unknown = set(intrinsics) - {name for camera in names for name in camera}
    if unknown:
        raise ArgumentError(f"intrinsics: no camera of this rig has {', '.join(sorted(unknown))}")
    if pixels.shape[1] != len(rig):
        raise ShapeError(
            f"pixels: expected those of {len(rig)} cameras (n, {len(rig)}, m, 2), got {tuple(pixels.shape)}"
        )
    bundle = _Bundle(rig, points, pixels, seen, names)
    vector, rms = bundle.solve()
    refined_cameras, poses, world_from_points = bundle.parts(vector)
    cameras = {
        name: _finished(new, camera)
        for (name, camera), new in zip(rig.cameras.items(), refined_cameras, strict=True)
    }
    refined = rig.replaced(cameras, poses.to(rig.world_from_camera))
    return RefinedRig(refined, world_from_points, bundle.all_residuals(vector), rms)


def _intrinsics(camera: Camera) -> list[str]:
    return [name for name in camera.intrinsic_names if getattr(camera, name) is not None]


def refinable_intrinsics(camera: Camera) -> list[str]:
    """Names of the intrinsics that ``refine`` changes: of two polynomials that must agree, the first alone."""
    return _intrinsics(_started(camera))


def _free_names(camera: Camera, fixed: Sequence[str]) -> list[str]:
    names = _intrinsics(camera)
    unknown = set(fixed) - set(names)
    if unknown:
        raise ArgumentError(f"fixed: this camera has {', '.join(names)}, not {', '.join(sorted(unknown))}")
    free = [name for name in names if name not in fixed]
    if not free:
        raise ArgumentError(f"camera: nothing of {camera!r} is left to refine")
    return free


def _started(camera: Camera) -> Camera:
    """The camera in float64 on the CPU; one of two polynomials that must agree, by the first of them alone."""
    camera = camera.to("cpu", torch.float64)
    return camera.exact() if isinstance(camera, OCamCamera) else camera


def _finished(refined: Camera, like: Camera) -> Camera:
    """The refined camera as the given one: with its limits, dtype and, if it had one, an inverse polynomial."""
    refined = refined.with_max_angle(like.max_angle.to(refined.max_angle))
    if (
        isinstance(like, OCamCamera)
        and like.inverse_polynomial is not None
        and isinstance(refined, OCamCamera)
    ):
        refined = fit_inverse_polynomial(refined, len(like.inverse_polynomial) - 1).camera
    return refined.to(like.device, like.dtype)


def _moves(changes: Tensor) -> Tensor:
    """Rigid transforms (*, 4, 4) of rotation vectors and shifts (*, 6), smooth at 0, where the search begins."""
    vector, shift = changes[..., :3], changes[..., 3:]
    last = torch.tensor([0.0, 0.0, 0.0, 1.0]).to(vector).expand(*vector.shape[:-1], 1, 4)
    return torch.cat((torch.cat((rotations(vector), shift.unsqueeze(-1)), -1), last), -2)


class _Bundle:
    """Everything that is adjusted, as one vector: intrinsics, then poses of cameras, then those of the object.

    Poses are changes, axis-angle and shift, of those that the search starts from; the first camera's is not among them.
    """

    def __init__(
        self, rig: CameraRig, points: Tensor, pixels: Tensor, seen: Tensor | None, free: list[list[str]]
    ) -> None:
        self.cameras = [_started(camera) for camera in rig.cameras.values()]
        self.points = points.detach().to("cpu", torch.float64)
        self.pixels = pixels.detach().to("cpu", torch.float64)
        visible = self.pixels.isfinite().all(-1)
        if seen is not None:
            visible &= seen.cpu()
        self.seen = visible & (visible.sum(-1, keepdim=True) >= FEWEST)
        self.free = free
        self.camera_from_world = rig.camera_from_world.detach().to("cpu", torch.float64)
        self.world_from_points, used = self._first_poses()
        if not bool(used.any()):
            raise ArgumentError(
                f"pixels: no view has {FEWEST} points that were seen, which it takes to find a pose"
            )
        self.lengths = [
            [getattr(camera, name).numel() for name in names]
            for camera, names in zip(self.cameras, free, strict=True)
        ]
        self.num_intrinsics = sum(map(sum, self.lengths))
        self.num_moved = len(self.cameras) - 1

    def _first_poses(self) -> tuple[Tensor, Tensor]:
        """For each view the pose by the camera that sees most of it; and which views have one."""
        poses = torch.eye(4, dtype=torch.float64).repeat(len(self.pixels), 1, 1)
        used = self.seen.any(-1).any(-1)
        for view in used.nonzero().flatten().tolist():
            best = int(self.seen[view].sum(-1).argmax())
            mask = self.seen[view, best]
            directions = self.cameras[best].unproject(self.pixels[view, best, mask]).directions
            pose = pose_from_directions(self.points[mask], directions)
            poses[view] = invert_transform(self.camera_from_world[best]) @ pose
        return poses, used

    @property
    def start(self) -> Tensor:
        """The vector of what was given."""
        intrinsics = [
            getattr(camera, name).reshape(-1)
            for camera, names in zip(self.cameras, self.free, strict=True)
            for name in names
        ]
        moves = torch.zeros(6 * (self.num_moved + len(self.pixels)), dtype=torch.float64)
        return torch.cat([*intrinsics, moves])

    def limits(self) -> tuple[Tensor, Tensor]:
        """Smallest and largest values, as far as a model has any."""
        low = torch.full_like(self.start, -torch.inf)
        high, at = -low, 0
        for camera, names, lengths in zip(self.cameras, self.free, self.lengths, strict=True):
            choices = fit_choices(type(camera))
            bounds = {} if choices is None else choices.bounds
            for name, length in zip(names, lengths, strict=True):
                if name in bounds:
                    low[at : at + length], high[at : at + length] = bounds[name]
                at += length
        return low, high

    def _intrinsic_places(self, index: int) -> slice:
        start = sum(map(sum, self.lengths[:index]))
        return slice(start, start + sum(self.lengths[index]))

    def _with(self, index: int, values: Tensor) -> Camera:
        """Camera ``index`` with intrinsics from ``values`` (*, p), one camera for each."""
        camera, lead = self.cameras[index], values.shape[:-1]
        tensors = {name: getattr(camera, name) for name in (*_intrinsics(camera), "max_angle")}
        tensors = {name: tensor.expand((*lead, *tensor.shape)) for name, tensor in tensors.items()}
        values_by_name = values.split(self.lengths[index], dim=-1)
        for name, part in zip(self.free[index], values_by_name, strict=True):
            tensors[name] = part.reshape((*lead, *getattr(camera, name).shape))
        return camera.with_intrinsics(tensors)

    def _predicted(
        self, index: int, intrinsics: Tensor, camera: Tensor, views: Tensor, view: Tensor
    ) -> Tensor:
        """Pixels (k, 2) of the seen points of one camera; intrinsics and its move once, or a row for each point."""
        point_indices = self.seen[:, index].nonzero()[:, 1]
        # An object's move is one in the world, a camera's one in its own frame, and the first camera has none.
        pose = self.camera_from_world[index] @ _moves(view) @ self.world_from_points[views]
        if index:
            pose = _moves(camera) @ pose
        local = transform_points(pose, self.points[point_indices, None]).squeeze(-2)
        return self._with(index, intrinsics).project(local).pixels

    def _parts_of(self, index: int, vector: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Intrinsics (p,) and move (6,) of one camera; for each of its seen points, which view, and its move (k, 6)."""
        views = self.seen[:, index].nonzero()[:, 0]
        moves = vector[self.num_intrinsics :].reshape(-1, 6)
        camera = moves[index - 1] if index else torch.zeros(6, dtype=torch.float64)
        return vector[self._intrinsic_places(index)], camera, views, moves[self.num_moved + views]

    def residuals(self, vector: Tensor) -> Tensor:
        """Projection minus pixel of all that was seen, camera by camera, (r,)."""
        blocks = [
            self._predicted(index, *self._parts_of(index, vector))
            - self.pixels[:, index][self.seen[:, index]]
            for index in range(len(self.cameras))
        ]
        return torch.cat(blocks).flatten()

    @torch.enable_grad()
    def jacobian(self, vector: Tensor) -> Tensor:
        """Derivatives (r, p): every point has a copy of what it depends on, so two backward passes make all rows."""
        blocks = []
        for index in range(len(self.cameras)):
            intrinsics, camera, views, view = self._parts_of(index, vector)
            each = (intrinsics.expand(len(views), -1), camera.expand(len(views), -1), view)
            copies = [part.detach().clone().requires_grad_() for part in each]
            pixels = self._predicted(index, copies[0], copies[1], views, copies[2])
            rows = pixels.new_zeros(len(views), 2, len(vector))
            for axis in range(2):
                total = pixels[:, axis].sum()
                gradients = torch.autograd.grad(total, copies, retain_graph=True, allow_unused=True)
                by_intrinsics, by_camera, by_view = (
                    torch.zeros_like(part) if gradient is None else gradient
                    for gradient, part in zip(gradients, copies, strict=True)
                )
                rows[:, axis, self._intrinsic_places(index)] = by_intrinsics
                # Moves are those of cameras but the first, then those of views.
                if index:
                    start = self.num_intrinsics + 6 * (index - 1)
                    rows[:, axis, start : start + 6] = by_camera
                first = self.num_intrinsics + 6 * (self.num_moved + views)
                rows[:, axis].scatter_(1, first[:, None] + torch.arange(6), by_view)
            blocks.append(rows.flatten(0, 1))
        return torch.cat(blocks).detach()

    def solve(self) -> tuple[Tensor, float]:
        """The best vector, and the root mean square distance in pixels."""
        low, high = self.limits()
        jacobian: Callable[[Tensor], Tensor] = self.jacobian
        solution, rms = solve_least_squares(self.residuals, self.start, jacobian, low, high)
        return solution, rms * 2**0.5  # of both components

    def parts(self, vector: Tensor) -> tuple[list[Camera], Tensor, Tensor]:
        """Cameras, their poses in the world, and the object's."""
        cameras = [
            self._with(index, vector[self._intrinsic_places(index)]) for index in range(len(self.cameras))
        ]
        moves = vector[self.num_intrinsics :].reshape(-1, 6)
        moved = torch.cat((moves.new_zeros(1, 6), moves[: self.num_moved]))
        from_world = _moves(moved) @ self.camera_from_world
        views = moves[self.num_moved :]
        boards = _moves(views) @ self.world_from_points
        return cameras, invert_transform(from_world), boards

    def all_residuals(self, vector: Tensor) -> Tensor:
        """(n, cameras, m, 2), 0 where not seen."""
        table = torch.zeros_like(self.pixels)
        flat = self.residuals(vector).reshape(-1, 2)
        counts = [int(self.seen[:, index].sum()) for index in range(len(self.cameras))]
        for index, part in enumerate(flat.split(counts)):
            table[:, index][self.seen[:, index]] = part
        return table
