# SPDX-License-Identifier: Apache-2.0
"""A camera or a rig from pictures of a known object alone, whatever the model: no calibration to start from."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sphericalvision.cameras.base import Camera
from sphericalvision.cameras.conversion.convert import convert
from sphericalvision.cameras.field_of_view import field_of_view as view_of
from sphericalvision.cameras.models.fisheye import FisheyeCamera
from sphericalvision.cameras.models.kannala_brandt import KannalaBrandtCamera
from sphericalvision.cameras.rig import CameraRig
from sphericalvision.capture.calibrating.refine import (
    FEWEST,
    RefinedCamera,
    RefinedRig,
    refinable_intrinsics,
    refine,
    refine_rig,
)
from sphericalvision.core import ArgumentError, ShapeError
from sphericalvision.geometry import angle_from_axis, invert_transform, transform_points
from sphericalvision.shapes import check_shapes

_WRONG = 4.5
"""Times the median distance from the pixel at which a corner is none: one of 700,000 with noise alone."""
_REACH = 1.05
"""Times the largest angle from the axis of any point seen: where a lens ends."""
_AGREES = 0.2
"""Times the distance between poses as they are, below which they agree once an object is counted from its other end."""
_APART, _PIXELS = 5.0, 1.0
"""Times the error of a camera alone, and pixels, above which it contradicts the others."""


@check_shapes
def calibrate_camera(
    points: Float[Tensor, "m 3"],
    pixels: Float[Tensor, "n m 2"],
    image_size: Sequence[int],
    model: type[Camera] | str = KannalaBrandtCamera,
    seen: Bool[Tensor, "n m"] | None = None,
    *,
    field_of_view: float = math.pi,
    num_coefficients: int | None = None,
    projection: str | None = None,
) -> RefinedCamera:
    """The camera of a model that explains ``pixels`` (n, m, 2) of an object's ``points`` (m, 3) best.

    An ideal fisheye is refined, then a Kannala-Brandt lens that starts from it, and then the wanted model.
    Views should reach all parts of the image, and the object be tilted in some of them.

    Args:
        points: (m, 3) in the object's frame, metres; z = 0 for a board.
        pixels: (n, m, 2) as (u, v), where each point was found.
        image_size: (height, width).
        model: class of the camera, or its name in files.
        seen: (n, m), which were found; all by default.
        field_of_view: roughly that of the shorter side of the image, in radians; within a third of the truth is enough.
        num_coefficients: of the model, where it has a choice, as in ``convert``.
        projection: of ``FisheyeCamera``, as in ``convert``.

    Raises:
        ArgumentError: no view has enough points, or the model cannot show what is seen.
        ShapeError: the shapes do not fit.

    Examples:
        >>> from sphericalvision.geometry import transform_from_axis_angle, transform_points
        >>> truth = FisheyeCamera.from_field_of_view((240, 320), 2.6, "equisolid", torch.float64)
        >>> board = torch.cartesian_prod(torch.arange(7.0), torch.arange(5.0), torch.zeros(1)).double() * 0.05
        >>> turns = torch.tensor([[0.0, 0.9, 0.1], [0.8, 0.0, 0.0], [0.1, -0.9, 0.3], [-0.7, 0.2, 0]]).double()
        >>> places = torch.tensor([[0.1, -0.1, 0.2], [-0.2, 0.05, 0.2], [-0.5, 0.0, 0.2], [-0.1, -0.4, 0.2]]).double()
        >>> at = truth.project(transform_points(transform_from_axis_angle(turns, places), board))
        >>> found = calibrate_camera(board, at.pixels, (240, 320), FisheyeCamera, at.valid, projection="equisolid")
        >>> bool((found.camera.focal_length - truth.focal_length).abs().max() < 1e-4)
        True
    """
    if not 0 < field_of_view < 2 * math.pi:
        raise ArgumentError(f"field_of_view: expected radians in (0, 2π), got {field_of_view}")
    ideal = FisheyeCamera.from_field_of_view(image_size, field_of_view, dtype=torch.float64)
    camera: Camera = ideal.with_max_angle(math.pi)
    # The axis stays in the middle of the image until the focal length, which may be a third off, is about right.
    camera = refine(camera, points, pixels, seen, fixed=("principal_point",)).camera
    camera = refine(camera, points, pixels, seen).camera
    camera = convert(camera, KannalaBrandtCamera, num_coefficients=2).camera
    # A Kannala-Brandt lens of two coefficients is the start of every model, which is then fitted to it.
    refined = refine(camera, points, pixels, seen)
    # Nothing is known of the lens beyond what was seen
    reached = min(math.pi, _REACH * float(refined.camera.max_angle), view_of(refined.camera).widest)
    camera = refined.camera.with_max_angle(reached)
    start = convert(camera, model, num_coefficients=num_coefficients, projection=projection).camera
    return refine(start, points, pixels, seen)


@check_shapes
def calibrate_rig(
    points: Float[Tensor, "m 3"],
    pixels: Float[Tensor, "n cameras m 2"],
    image_sizes: Mapping[str, Sequence[int]],
    model: type[Camera] | str = KannalaBrandtCamera,
    seen: Bool[Tensor, "n cameras m"] | None = None,
    *,
    field_of_view: float = math.pi,
    num_coefficients: int | None = None,
    projection: str | None = None,
) -> RefinedRig:
    """The rig, with cameras of one model, that explains ``pixels`` of an object's ``points`` (m, 3) best.

    Each camera alone by ``calibrate_camera``; then, along the pairs that saw the object together most often, the poses
    from where both say that it stood; then everything together by ``refine_rig``, twice: points that miss by more than
    4.5 times the median are left out the second time, and views that do so as a whole, by where the other cameras say
    that the object stood, from the first. The world is the first camera. What lies more than 5 % beyond the
    outermost point that was seen counts as out of view: nothing is known of the lens there. A board that looks the same
    upside down, with inner corners that are even or odd both ways, may be counted from its other end by some cameras:
    they are told by their poses.

    Args:
        points: (m, 3) in the object's frame, metres; z = 0 for a board.
        pixels: (n, cameras, m, 2) as (u, v), of n moments at each of which the object stood somewhere.
        image_sizes: name of each camera, in order -> (height, width).
        model: class of the cameras, or its name in files.
        seen: (n, cameras, m), which were found; all by default. Cameras need not see the same points of the object.
        field_of_view: roughly that of the shorter side of the images, in radians; within a third is enough.
        num_coefficients: of the model, where it has a choice, as in ``convert``.
        projection: of ``FisheyeCamera``, as in ``convert``.

    Raises:
        ArgumentError: a camera has no view with enough points, no view ties it to the first camera, or it contradicts
            the others.
        ShapeError: the shapes do not fit.

    Examples:
        >>> from sphericalvision.cameras import ring_rig
        >>> from sphericalvision.geometry import transform_from_axis_angle, transform_points
        >>> truth = ring_rig(2, 0.03, (240, 240), 3.5).to(torch.float64)
        >>> board = torch.cartesian_prod(torch.arange(9.0), torch.arange(7.0), torch.zeros(1)).double() * 0.05
        >>> turns = torch.tensor([[0.0, angle, 0.3 * angle] for angle in (-2, -1.4, -1, -0.5, 0, 0.5, 1, 1.5, 2)])
        >>> places = transform_from_axis_angle(turns, torch.zeros(9, 3)).double()
        >>> away = transform_from_axis_angle(torch.tensor([0.3, 0.2, 0]), torch.tensor([-0.2, -0.2, 0.3])).double()
        >>> places = torch.cat((places, truth.world_from_camera[:1] @ truth.world_from_camera[1:].inverse() @ places))
        >>> at = truth.project(transform_points(places @ away, board).reshape(-1, 3))
        >>> pixels = at.pixels.reshape(2, 18, -1, 2).movedim(0, 1)
        >>> seen = at.valid.reshape(2, 18, -1).movedim(0, 1)
        >>> sizes = {"front": (240, 240), "back": (240, 240)}
        >>> found = calibrate_rig(board, pixels, sizes, FisheyeCamera, seen, projection="equidistant")
        >>> found.rig.names, found.rms_error < 1e-3
        (['front', 'back'], True)
    """
    names = list(image_sizes)
    if pixels.shape[1] != len(names):
        raise ShapeError(f"pixels: expected (n, {len(names)}, m, 2), got {tuple(pixels.shape)}")
    seen = torch.ones(pixels.shape[:-1], dtype=torch.bool) if seen is None else seen
    counts = seen.sum(-1)
    # 1. Each camera alone, with the pose of the object in each of its views.
    alone, errors = {}, []
    for place, (name, size) in enumerate(image_sizes.items()):
        views = (counts[:, place] >= FEWEST).nonzero().flatten()
        if not len(views):
            raise ArgumentError(f"pixels: camera {name} has no view with {FEWEST} points")
        calibration = calibrate_camera(
            points,
            pixels[views, place],
            size,
            model,
            seen[views, place],
            field_of_view=field_of_view,
            num_coefficients=num_coefficients,
            projection=projection,
        )
        poses_by_view = dict(zip(views.tolist(), calibration.camera_from_points, strict=True))
        alone[name] = calibration.camera, poses_by_view
        errors.append(calibration.rms_error)
    # 2. Poses of the cameras along the pairs with most views in common; boards that look the same upside down are
    #    renumbered by them before anything is fitted together.
    half_turn = _half_turn(points)
    poses = _poses(names, alone, half_turn)
    turned = _turned(poses, alone, half_turn)
    pixels, seen = _renumbered(pixels, turned), _renumbered(seen, turned)
    for view, place in turned:
        alone[names[place]][1][view] = alone[names[place]][1][view] @ half_turn
    rig = CameraRig({name: camera for name, (camera, _) in alone.items()}, poses)
    # 3. Everything together, without views that contradict the others: least squares would spread their error.
    free = sorted({name for camera in rig.cameras.values() for name in refinable_intrinsics(camera)})
    agreeing = seen.cpu() & ~_astray(rig, alone, points, pixels, seen)[..., None]
    refined = refine_rig(rig, points, pixels, agreeing, intrinsics=free)
    # 4. Once more without single corners that are wrong, which only the joint fit tells from noise.
    misses = refined.residuals.norm(dim=-1)
    typical = float(misses[misses > 0].median()) if bool((misses > 0).any()) else 0.0
    wrong = misses > max(_WRONG * typical, 1e-6)
    if bool(wrong.any()):
        refined = refine_rig(refined.rig, points, pixels, agreeing & ~wrong, intrinsics=free)
    # 5. Nothing is known of a lens beyond the outermost corner that it was shown.
    _check_agreement(names, refined, seen, errors)
    cameras = {
        name: camera.with_max_angle(min(_REACH * _farthest(refined, place, pixels), float(camera.max_angle)))
        for place, (name, camera) in enumerate(refined.rig.cameras.items())
    }
    residuals = _renumbered(refined.residuals, turned)
    return refined._replace(rig=refined.rig.replaced(cameras), residuals=residuals)


def _farthest(refined: RefinedRig, place: int, pixels: Tensor) -> float:
    """The largest angle from the axis at which a camera was shown a point."""
    used = refined.residuals[:, place].abs().sum(-1) > 0
    rays = list(refined.rig.cameras.values())[place].unproject(pixels[:, place][used].double()).directions
    return float(angle_from_axis(rays).max())


def _half_turn(points: Tensor) -> Tensor | None:
    """The motion (4, 4) of a flat object that takes each point to the one as far from the other end; None without."""
    motion = torch.diag(torch.tensor([-1.0, -1.0, 1.0, 1.0], dtype=torch.float64))
    points = points.detach().to("cpu", torch.float64)
    motion[:2, 3] = 2 * points.mean(0)[:2]
    distance = (transform_points(motion, points) - points.flip(0)).abs().max()
    return motion if distance < 1e-6 * (points - points[0]).abs().max() else None


def _turned(
    poses: Tensor, alone: Mapping[str, tuple[Camera, dict[int, Tensor]]], half_turn: Tensor | None
) -> list[tuple[int, int]]:
    """Views and cameras that count the object from the other end than the first camera that sees it then."""
    if half_turn is None:
        return []
    turned, first = [], dict[int, Tensor]()
    for place, (_, views) in enumerate(alone.values()):
        for view, pose in views.items():
            stood = poses[place] @ pose
            reference = first.setdefault(view, stood)
            if (stood @ half_turn - reference).norm() < _AGREES * (stood - reference).norm():
                turned.append((view, place))
    return turned


def _renumbered(values: Tensor, turned: list[tuple[int, int]]) -> Tensor:
    """Values (n, cameras, m, ...) with the points of these views and cameras counted from the other end."""
    values = values.clone()
    for view, place in turned:
        values[view, place] = values[view, place].flip(0)
    return values


def _astray(
    rig: CameraRig,
    alone: Mapping[str, tuple[Camera, dict[int, Tensor]]],
    points: Tensor,
    pixels: Tensor,
    seen: Tensor,
) -> Tensor:
    """Views of cameras (n, cameras) that show the object elsewhere than the camera whose pose the others agree with.

    Least squares would spread what is wrong in one view over the poses of all cameras.
    """
    errors = torch.zeros(seen.shape[:2], dtype=torch.float64)
    for view in range(len(seen)):
        cameras = [place for place, (_, poses) in enumerate(alone.values()) if view in poses]
        if len(cameras) < 2:
            continue
        camera_from_points = torch.stack([alone[rig.names[at]][1][view] for at in cameras])
        stood = rig.world_from_camera[cameras] @ camera_from_points
        distances = torch.cdist(stood.flatten(1), stood.flatten(1)).sum(-1)
        reference = int(distances.argmin())
        for place in cameras[:reference] + cameras[reference + 1 :]:
            visible = seen[view, place].cpu()
            expected = rig.camera_from_world[place] @ stood[reference]
            local = transform_points(expected, points.to(stood)[visible])
            misses = alone[rig.names[place]][0].project(local).pixels - pixels[view, place].to(stood)[visible]
            errors[view, place] = misses.norm(dim=-1).nan_to_num(torch.inf).median()
    limit = max(_WRONG * float(errors[errors > 0].median()), _PIXELS) if bool(errors.any()) else torch.inf
    return errors > limit


def _check_agreement(names: list[str], refined: RefinedRig, seen: Tensor, errors: Sequence[float]) -> None:
    """Refuse a rig of cameras each of which explains its own pictures, and not those that it shares."""
    used = refined.residuals.abs().sum(-1) > 0
    for place, (name, alone) in enumerate(zip(names, errors, strict=True)):
        count, enough = int(used[:, place].sum()), seen[:, place].sum(-1, keepdim=True) >= FEWEST
        total = int((seen[:, place] & enough).sum())
        together = float((refined.residuals[:, place].square().sum() / max(count, 1)).sqrt())
        if together > max(_APART * alone, _PIXELS) or 2 * count < total:
            raise ArgumentError(
                f"pixels: {name} contradicts the other cameras: alone its views fit to {alone:.2f} px, together to "
                f"{together:.2f} px, with {total - count} of {total} points left out. Are all views of one moment, and "
                "each point the same one in all cameras? A board that looks the same upside down, or turned by 90°, is "
                "counted from another corner: take one with an even and an odd number of inner corners, or with markers"
            )


def _poses(
    names: list[str], alone: Mapping[str, tuple[Camera, dict[int, Tensor]]], half_turn: Tensor | None
) -> Tensor:
    """World from camera (n, 4, 4), the first being the world: along pairs with most views of the object in common."""
    same = torch.eye(4, dtype=torch.float64)

    def relative(one: str, other: str, views: list[int], motion: Tensor = same) -> Tensor:
        """By each view, one camera from the other: the object of the other moved in its frame."""
        return torch.stack(
            [alone[one][1][view] @ motion @ invert_transform(alone[other][1][view]) for view in views]
        )

    poses = {names[0]: same}
    while len(poses) < len(names):
        pairs = [(reference, other) for reference in poses for other in names if other not in poses]
        shared = {pair: sorted(alone[pair[0]][1].keys() & alone[pair[1]][1].keys()) for pair in pairs}
        reference, other = max(pairs, key=lambda pair: len(shared[pair]))
        if not shared[reference, other]:
            raise ArgumentError(
                f"pixels: no view of the object is shared by {', '.join(poses)} and "
                f"{', '.join(name for name in names if name not in poses)}, so nothing ties them together; hold a "
                "board where the edges of both images show a part of it at the same moment"
            )
        views = shared[reference, other]
        transforms = relative(reference, other, views)
        # The one that the others agree with.
        distances = torch.cdist(transforms.flatten(1), transforms.flatten(1)).sum(-1)
        best = transforms[distances.argmin()]
        if half_turn is not None:
            variants = torch.stack((transforms, relative(reference, other, views, half_turn)))
            candidates = variants.flatten(0, 1)
            turned_apart = torch.cdist(candidates.flatten(1), variants.flatten(2)).amin(0).sum(-1)
            if turned_apart.min() < _AGREES * distances.min():
                best = candidates[turned_apart.argmin()]
        poses[other] = poses[reference] @ best
    return torch.stack([poses[name] for name in names])
