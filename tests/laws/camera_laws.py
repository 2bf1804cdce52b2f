# SPDX-License-Identifier: Apache-2.0
"""What must hold for every camera model, written once.

A law takes a camera and fails with an assertion. A new model is tested by one more entry in the table of
``tests/laws/cameras.py``.
"""

from __future__ import annotations

import inspect
import math
from typing import Any

import pytest
import torch
from torch import Tensor

from sphericalvision.cameras import Camera
from sphericalvision.core import ArgumentError, ShapeError
from tests.laws.cameras import CameraCase


def hold_everywhere(condition: Tensor, values: Tensor, law: str) -> None:
    """Fail with the first of ``values`` (*, k), points or pixels, where a condition (*) does not hold."""
    failed = ~condition
    if failed.any():
        first = values[failed][0].tolist()
        raise AssertionError(
            f"{law}: not so at {int(failed.sum())} of {failed.numel()}, the first at {first}"
        )


INSIDE = 0.995  # of the field of view: laws on what a camera sees keep away from the very edge


def circle(angle: Tensor, azimuth: float | Tensor = 0.7) -> Tensor:
    """Unit vectors (*, 3) at angles (*) from the axis."""
    angle, azimuth = torch.broadcast_tensors(angle, torch.as_tensor(azimuth, dtype=angle.dtype))
    return torch.stack((angle.sin() * azimuth.cos(), angle.sin() * azimuth.sin(), angle.cos()), -1)


def directions_within(camera: Camera, count: int = 400, fraction: float = INSIDE) -> Tensor:
    """Directions spread evenly over angle and azimuth out to ``fraction`` of the field of view, (count, 3)."""
    steps = torch.arange(count, dtype=torch.float64)
    angle = (steps + 0.5) / count * fraction * float(camera.max_angle)
    return circle(angle, steps * math.pi * (3 - math.sqrt(5))).to(camera.dtype)


def directions_seen(camera: Camera, count: int = 400) -> Tensor:
    """Those of ``directions_within`` that fall on the image, at least a pixel from its border."""
    points = directions_within(camera, count)
    height, width = camera.image_size
    u, v = camera.project(points).pixels.unbind(-1)
    seen = points[(u > 0.5) & (u < width - 1.5) & (v > 0.5) & (v < height - 1.5)]
    assert len(seen) > count // 4, "the camera of this test should see a good part of its field of view"
    return seen


def pixels_seen(camera: Camera, count: int = 400) -> Tensor:
    """Pixels at random places of the image that look within the field of view, (n, 2)."""
    generator = torch.Generator().manual_seed(1)
    height, width = camera.image_size
    size = torch.tensor([width - 1.0, height - 1.0], dtype=torch.float64)
    # As its generator is
    places = torch.rand(count, 2, generator=generator, dtype=torch.float64, device="cpu")
    pixels = (places.to(size.device) * size).to(camera.dtype)
    directions, valid = camera.unproject(pixels)
    inside = angle_between(directions, directions.new_tensor([0.0, 0.0, 1.0])) < INSIDE * camera.max_angle
    assert (valid & inside).sum() > count // 4
    return pixels[valid & inside]


def angle_between(a: Tensor, b: Tensor) -> Tensor:
    """Angle in radians, exact for small ones too."""
    a, b = torch.broadcast_tensors(a.double(), b.double())
    return torch.atan2(torch.linalg.cross(a, b).norm(dim=-1), (a * b).sum(-1))


def pixel_precision(camera: Camera) -> float:
    """A few units in the last place of the largest pixel coordinate."""
    return 64 * torch.finfo(camera.dtype).eps * max(camera.image_size)


def law_unproject_undoes_project(camera: Camera, tolerance: float) -> None:
    """Round trip from directions; ``tolerance`` in pixels is turned into an angle."""
    directions = directions_seen(camera)
    pixels, valid = camera.project(directions)
    back, back_valid = camera.unproject(pixels)
    hold_everywhere(valid, directions, "what falls on the image is seen")
    hold_everywhere(back_valid, pixels, "what a camera sees, it looks at")
    neighbour = camera.unproject(pixels + 0.25).directions  # how far a quarter of a diagonal pixel is, here
    allowed = tolerance * angle_between(back, neighbour) / 0.25 + 16 * torch.finfo(camera.dtype).eps
    hold_everywhere(angle_between(directions, back) <= allowed, directions, "unproject undoes project")


def law_project_undoes_unproject(camera: Camera, tolerance: float) -> None:
    """Round trip from pixels."""
    pixels = pixels_seen(camera)
    directions, valid = camera.unproject(pixels)
    back, back_valid = camera.project(directions)
    hold_everywhere(valid, pixels, "what lies on the image is looked at")
    hold_everywhere(back_valid, directions, "what a camera looks at, it sees")
    near = (back - pixels).abs().amax(-1) <= tolerance
    hold_everywhere(near, pixels, f"project undoes unproject within {tolerance:.2g} px")


def inner_angle(camera: Camera, fraction: float) -> float:
    """``max_angle`` where the model goes on beyond it; else ``fraction`` of it.

    Where a model ends its image radius may stop growing, and then its inverse has no derivative.
    """
    edge = float(camera.max_angle)
    beyond = torch.tensor([[math.sin(1.01 * edge), 0.0, math.cos(1.01 * edge)]], dtype=torch.float64)
    goes_on = 1.01 * edge < math.pi and bool(camera.to(torch.float64)._project(beyond).valid)
    return edge if goes_on else fraction * edge


def law_round_trip_is_exact(camera: Camera, case: CameraCase) -> None:
    """From 1e-6 rad off the axis to ``max_angle`` (0.99 of it where the model ends): 1e-10 px and 1e-12 rad in float64.

    In float32 the bounds are 16 units in the last place of the largest pixel coordinate, and of the angle that these
    are or one radian, whichever is more.
    """
    if case.own_tolerance:
        pytest.skip("its file's two polynomials are not inverse to each other")
    eps = torch.finfo(camera.dtype).eps
    edge = inner_angle(camera, 0.99)
    angle = torch.cat((torch.logspace(-6, -1, 26), torch.linspace(0.1, 1, 200) * edge)).double()
    points = circle(angle, 2.4 * torch.arange(len(angle), dtype=torch.float64))
    points = points[angle <= edge].to(camera.dtype)
    pixels, seen = camera.project(points)
    points, pixels = points[seen], pixels[seen]
    assert len(points) > 60
    directions, valid = camera.unproject(pixels)
    again, again_valid = camera.project(directions)
    hold_everywhere(valid, pixels, "what a camera sees, it looks at")
    hold_everywhere(again_valid, directions, "what a camera looks at, it sees")
    pixel_error = (again - pixels).norm(dim=-1)
    angle_error = angle_between(directions, points)
    side = max(camera.image_size)
    if camera.dtype == torch.float64:
        hold_everywhere(pixel_error <= 1e-10, points, "1e-10 px")
        hold_everywhere(angle_error <= 1e-12, points, "1e-12 rad")
    else:
        radian_per_pixel = angle_between(directions, camera.unproject(pixels + 0.25).directions) / 0.25
        hold_everywhere(pixel_error <= 16 * eps * side, points, "16 units in the last place of pixels")
        bound = 16 * eps * (1 + side * radian_per_pixel)
        hold_everywhere(angle_error <= bound, points, "16 units in the last place of angles")


def law_nan_is_invalid(camera: Camera) -> None:
    """Values that are no numbers stop nothing, and are reported."""
    nan, inf = math.nan, math.inf
    points = torch.tensor(
        [[nan, 0.0, 1.0], [0.0, nan, 1.0], [0.1, 0.0, nan], [nan, nan, nan]], dtype=camera.dtype
    )
    hold_everywhere(~camera.project(points).valid, points, "NaN is not seen")
    pixels = torch.tensor([[nan, 40.0], [40.0, nan], [nan, nan], [inf, 40.0]], dtype=camera.dtype)
    hold_everywhere(~camera.unproject(pixels).valid, pixels, "NaN looks nowhere")


def law_directions_are_unit(camera: Camera) -> None:
    """Also of pixels outside of the image."""
    pixels = torch.cat((camera.pixel_grid()[::7, ::7].reshape(-1, 2), pixels_outside(camera)))
    length = camera.unproject(pixels).directions.norm(dim=-1)
    torch.testing.assert_close(length, torch.ones_like(length))


def law_length_does_not_matter(camera: Camera) -> None:
    """A point at any distance on a ray has the ray's pixel and validity, as far as its numbers can be held."""
    tolerance = pixel_precision(camera)
    directions = directions_within(camera, fraction=0.98)
    near, near_valid = camera.project(directions)
    limits = torch.finfo(camera.dtype)
    powers = torch.cat((torch.linspace(-35.0, 37.0, 37), torch.tensor([-5.5, -5.0, -4.5, -4.0, 9.5, 10.0])))
    distances = directions.new_tensor([*(10.0**powers).tolist(), limits.tiny**0.95, limits.max / 2])
    points = distances[:, None, None] * directions
    far, far_valid = camera.project(points)
    hold_everywhere((far - near).abs().amax(-1) <= tolerance, points, "equal at any distance")
    assert (
        (far_valid == near_valid).float().mean(-1) > 0.99
    ).all()  # rounding may flip a point on the border


def law_nothing_at_infinity_is_seen(camera: Camera) -> None:
    """Where it lies nobody knows: a component may be finite or not."""
    inf = math.inf
    points = torch.tensor(
        [[inf, 0.0, 1.0], [0.0, 0.0, inf], [0.0, -inf, 0.0], [inf, inf, inf]], dtype=camera.dtype
    )
    hold_everywhere(~camera.project(points).valid, points, "nothing at infinity is seen")


def pixels_outside(camera: Camera) -> Tensor:
    """Pixels beyond each border and each corner, near and far, (n, 2)."""
    height, width = camera.image_size
    beyond = [-1e4, -1.0, width / 2, width + 1.0, 1e4], [-1e4, -1.0, height / 2, height + 1.0, 1e4]
    places = [(u, v) for u in beyond[0] for v in beyond[1] if not (0 < u < width and 0 < v < height)]
    return torch.tensor(places, dtype=camera.dtype)


def law_outside_is_invalid_and_finite(camera: Camera) -> None:
    """The camera's own centre, points beyond the field of view and pixels beyond the image."""
    edge = float(camera.max_angle)
    angles = torch.linspace(min(edge * 1.02, math.pi), math.pi, 20, dtype=torch.float64)
    points = torch.stack((angles.sin(), torch.zeros_like(angles), angles.cos()), -1).to(camera.dtype)
    if edge < math.pi:
        pixels, valid = camera.project(torch.cat((points, points[:, [1, 0, 2]], -points[:, [1, 0, 2]].abs())))
        assert not valid[: len(points)].any()
        assert not valid[len(points) : 2 * len(points)].any()
        assert pixels.isfinite().all()
    pixels, valid = camera.project(torch.zeros(1, 3, dtype=camera.dtype))
    assert not valid.any()
    assert pixels.isfinite().all()
    outside = pixels_outside(camera)
    directions, valid = camera.unproject(outside)
    hold_everywhere(~valid, outside, "pixels outside of the image look nowhere")
    hold_everywhere(directions.isfinite().all(-1), outside, "directions are finite")


def special_points(camera: Camera) -> Tensor:
    """On and all but on the axis, at 90°, at the edge and beyond, behind, and the camera's centre."""
    edge = float(camera.max_angle)
    tiny = 1e-10 if camera.dtype == torch.float64 else 1e-6
    angles = [0.0, tiny, 1e-3, math.pi / 2, edge * 0.999, edge, min(edge * 1.001, math.pi), 3.0, math.pi]
    points = [
        [math.sin(a) * math.cos(t), math.sin(a) * math.sin(t), math.cos(a)] for a in angles for t in (0, 1)
    ]
    points += [[0.0, 0.0, 1.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 0.0]]
    return torch.tensor(points, dtype=camera.dtype)


def special_pixels(camera: Camera) -> Tensor:
    """The principal point, corners, and pixels outside of the image."""
    height, width = camera.image_size
    corners = [(u, v) for u in (-0.5, width - 0.5) for v in (-0.5, height - 0.5)]
    center = getattr(camera, "principal_point", torch.tensor([(width - 1) / 2, (height - 1) / 2]))
    near = torch.tensor([[0.0, 0.0], [1e-7, 0.0], [1e-3, 1e-3]], dtype=camera.dtype)
    return torch.cat((center.to(camera.dtype) + near, near.new_tensor(corners), pixels_outside(camera)))


def law_gradients_are_finite(camera: Camera) -> None:
    """With respect to points, pixels and intrinsics, also where the answer is not valid."""
    for name, values in (("project", special_points(camera)), ("unproject", special_pixels(camera))):
        differentiable, leaves = with_gradients(camera)
        values = values.requires_grad_()
        result = getattr(differentiable, name)(values)[0]
        weights = torch.linspace(0.5, 1.5, result.numel(), dtype=result.dtype).reshape(result.shape)
        gradients = torch.autograd.grad((result * weights).sum(), [values, *leaves], allow_unused=True)
        for label, gradient in zip([name, *camera.intrinsic_names], gradients, strict=False):
            assert gradient is None or gradient.isfinite().all(), f"{name}: gradient of {label}"


def with_gradients(camera: Camera) -> tuple[Camera, list[Tensor]]:
    """The camera with intrinsics that require gradients, and these."""
    names = [name for name in camera.intrinsic_names if getattr(camera, name) is not None]
    leaves = [getattr(camera, name).detach().clone().requires_grad_() for name in names]
    return camera.with_intrinsics(dict(zip(names, leaves, strict=True))), leaves


def law_batch_equals_loop(camera: Camera, other: Camera) -> None:
    """A batch of cameras answers as its members do, with points of their own."""
    batch = type(camera).stack([camera, other, camera])
    points = directions_within(camera, 90).reshape(3, 5, 6, 3)
    pixels = camera.pixel_grid()[::9, ::9][:6, :5].expand(3, -1, -1, 2) + 0.25
    for name, values in (("project", points), ("unproject", pixels)):
        answer, valid = getattr(batch, name)(values)
        for index in range(3):
            one, one_valid = getattr(batch.select(index), name)(values[index])
            torch.testing.assert_close(answer[index], one, atol=pixel_precision(camera), rtol=0)
            assert torch.equal(valid[index], one_valid)
    assert torch.equal(batch.select(1).max_angle, other.max_angle)


def arguments_of(camera: Camera) -> dict[str, Any]:
    """What the constructor of its class wants to make the camera again."""
    names = [*camera.intrinsic_names, *camera.option_names, "image_size", "max_angle"]
    return {
        name: getattr(camera, name) for name in names if name in inspect.signature(type(camera)).parameters
    }


def each_parameter_alone_may_be_batched(camera: Camera) -> None:
    """Three values of one parameter and one of all others are three cameras, in all that cameras can do.

    Of shapes alone, so it is asked in one precision.
    """
    given = arguments_of(camera)
    for name in (*camera.intrinsic_names, "max_angle"):
        if given.get(name) is None:
            continue
        several = torch.stack([given[name] * factor for factor in (1.0, 0.995, 0.97)])
        batch = type(camera)(**{**given, name: several})
        members = [type(camera)(**{**given, name: value}) for value in several]
        assert batch.batch_shape == (3,)
        assert batch.equals(type(camera).stack(members)), name
        points = directions_within(camera, 90).reshape(3, 30, 3)
        pixels = (camera.pixel_grid()[::9, ::9].reshape(-1, 2)[:45] + 0.25).expand(3, -1, -1)
        assert_batch_answers_as(members, batch, points, pixels)
        for index, member in enumerate(members):
            assert batch.select(index).equals(member)
        expected, changed = [edited(member) for member in members], edited(batch)
        assert_batch_answers_as(expected, changed, points.to(changed.dtype), pixels.to(changed.dtype))


def edited(camera: Camera) -> Camera:
    """The camera after everything that can be done to it."""
    camera = camera.resized((90, 100)).with_max_angle(0.4).to(torch.float64)
    return camera.cropped(3, 4, 60, 70) if "principal_point" in camera.intrinsic_names else camera


def assert_batch_answers_as(members: list[Camera], batch: Camera, points: Tensor, pixels: Tensor) -> None:
    """A batch projects and unprojects as the members."""
    for verb, values in (("project", points), ("unproject", pixels)):
        answer, valid = getattr(batch, verb)(values)
        for index, member in enumerate(members):
            one, one_valid = getattr(member, verb)(values[index])
            torch.testing.assert_close(answer[index], one, atol=pixel_precision(member), rtol=0)
            assert torch.equal(valid[index], one_valid)


def law_half_precision_is_computed_in_float32(camera: Camera) -> None:
    """Points and pixels in half precision are numbers like others; intrinsics in half precision are refused."""
    for dtype in (torch.float16, torch.bfloat16):
        points = directions_within(camera, 60).to(dtype)
        pixels = (camera.pixel_grid()[::13, ::11].reshape(-1, 2)).to(dtype)
        for verb, values in (("project", points), ("unproject", pixels)):
            answer, valid = getattr(camera, verb)(values)
            expected = getattr(camera, verb)(values.float())
            assert answer.dtype == torch.float32
            assert torch.equal(answer, expected[0])
            assert torch.equal(valid, expected[1])
        image = camera.pixel_grid().movedim(-1, 0)
        values, valid = camera.sample(image.to(dtype), points)
        places = camera.sample(image.to(dtype).float(), points.float())[0]
        assert values.dtype == dtype
        torch.testing.assert_close(values, places.to(dtype))
        with pytest.raises(ArgumentError, match="float32 or float64"):
            camera.to(dtype)


def law_mistakes_are_named(camera: Camera) -> None:
    """Integers, arrays in place of tensors, and intrinsics that make no sense."""
    with pytest.raises(ArgumentError, match=r"points: expected floating point values, got torch.int64"):
        camera.project(torch.tensor([[0, 0, 1]]))
    with pytest.raises(ArgumentError, match="pixels: expected floating point"):
        camera.unproject(torch.tensor([[0, 0]]))
    with pytest.raises(ArgumentError, match=r"image: expected a torch.Tensor .* got numpy.ndarray"):
        camera.sample(torch.zeros(1, *camera.image_size).numpy(), directions_within(camera, 4))
    given = arguments_of(camera)
    nonsense: list[tuple[str, object]] = [("image_size", (0, 4))]
    for name in camera.intrinsic_names:
        if given[name] is not None:
            nonsense += [(name, torch.full_like(given[name], math.nan)), (name, "wide")]
    if "max_angle" in given:
        nonsense += [("max_angle", value) for value in (math.nan, -1.0, 0.0, 7.0, "wide", [])]
    if "focal_length" in given:
        nonsense.append(("focal_length", -given["focal_length"]))
    for name, value in nonsense:
        with pytest.raises((ArgumentError, ShapeError), match=name):
            type(camera)(**{**given, name: value})


def law_sampling_reads_the_projection(camera: Camera) -> None:
    """An image that holds its own pixel coordinates gives them back at the projected places."""
    points = directions_seen(camera)
    image = camera.pixel_grid().movedim(-1, 0)
    values, valid = camera.sample(image, points)
    assert valid.all()
    tolerance = 2 * pixel_precision(camera) + 1e-4 * (camera.dtype == torch.float32)
    torch.testing.assert_close(values.mT, camera.project(points).pixels, atol=tolerance, rtol=0)
