# SPDX-License-Identifier: Apache-2.0
"""What must hold for the derivatives of every camera model, and under the transforms and tracers of torch."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor, nn

from sphericalvision.cameras import Camera
from tests.laws.camera_laws import circle, directions_seen, inner_angle
from tests.laws.cameras import CameraCase

BOTH = ("project", "unproject")
ANGLES = (0.0, 1e-6, 0.7, math.pi / 2, math.radians(100.5))  # and the edge


def telling_directions(camera: Camera, on_axis: bool = True) -> Tensor:
    """On the axis, all but on it, half way, at 90°, past 100° and at the edge, where the model reaches, (n, 3)."""
    edge = inner_angle(camera, 0.97)
    angles = [angle for angle in (*ANGLES, edge) if angle <= edge and (on_axis or angle > 1e-5)]
    angle = torch.tensor(angles, dtype=torch.float64)
    return circle(angle, 0.4 + 1.7 * torch.arange(len(angles), dtype=torch.float64))


def intrinsics_of(camera: Camera) -> tuple[list[str], list[Tensor]]:
    """Names and values of the tensors that make the camera."""
    names = [name for name in camera.intrinsic_names if getattr(camera, name) is not None]
    return names, [getattr(camera, name).detach() for name in names]


def _function(camera: Camera, verb: str) -> Callable[..., Tensor]:
    """Pixels or directions as a function of points or pixels and of relative changes of the intrinsics."""
    names, tensors = intrinsics_of(camera)
    # Powers of pixels differ vastly
    scales = [torch.where(tensor == 0, 0.01, tensor.abs()) for tensor in tensors]

    def call(values: Tensor, *changes: Tensor) -> Tensor:
        changed = [t + c * s for t, c, s in zip(tensors, changes, scales, strict=True)]
        answer: Tensor = getattr(camera.with_intrinsics(dict(zip(names, changed, strict=True))), verb)(
            values
        )[0]
        return answer

    return call


def law_second_derivatives_are_right(camera: Camera, case: CameraCase) -> None:
    """Finite differences of values and of first derivatives, by points, pixels and intrinsics, in float64."""
    camera = camera.to(torch.float64)
    directions = telling_directions(camera, case.smooth_on_axis)
    lengths = torch.tensor([[1.0], [2.5]], dtype=torch.float64).repeat(3, 1)
    points = directions * lengths[: len(directions)]
    pixels = camera.project(points).pixels
    changes = [torch.zeros_like(tensor, requires_grad=True) for tensor in intrinsics_of(camera)[1]]
    for verb, values in zip(BOTH, (points, pixels), strict=True):
        call = _function(camera, verb)
        inputs = (values.detach().requires_grad_(), *changes)
        assert torch.autograd.gradcheck(call, inputs, atol=2e-4, rtol=1e-4, fast_mode=True)
        assert torch.autograd.gradgradcheck(call, inputs, atol=2e-3, rtol=1e-3, fast_mode=True)


def law_transforms_equal_the_loop(camera: Camera) -> None:
    """``torch.func``: vmap over values and over intrinsics, jacrev, jacfwd, hessian of one value."""
    camera = camera.to(torch.float64)
    points = telling_directions(camera)
    names, tensors = intrinsics_of(camera)
    several = [torch.stack((tensor, 1.01 * tensor)) for tensor in tensors]
    for verb, values in zip(BOTH, (points, camera.project(points).pixels), strict=True):

        def call(values: Tensor, *intrinsics: Tensor, verb: str = verb) -> Tensor:
            answer: Tensor = getattr(camera.with_intrinsics(dict(zip(names, intrinsics, strict=True))), verb)(
                values
            )[0]
            return answer

        close = {"atol": 1e-9, "rtol": 1e-9}
        one_by_one = torch.stack([call(value, *tensors) for value in values])
        torch.testing.assert_close(call(values, *tensors), one_by_one, **close)
        along = (0, *(None for _ in tensors))
        torch.testing.assert_close(torch.func.vmap(call, along)(values, *tensors), one_by_one, **close)
        if tensors:
            by_cameras = torch.func.vmap(call, (None, *(0 for _ in tensors)))(values, *several)
            loop = torch.stack([call(values, *(tensor[i] for tensor in several)) for i in range(2)])
            torch.testing.assert_close(by_cameras, loop, **close)
        by_autograd = torch.stack(
            [torch.autograd.functional.jacobian(lambda v, c=call: c(v, *tensors), value) for value in values]
        )
        for jacobian in (torch.func.jacrev, torch.func.jacfwd):
            found = torch.func.vmap(jacobian(call), along)(values, *tensors)
            torch.testing.assert_close(found, by_autograd, **close)
        if tensors:
            order = tuple(range(1, 1 + len(tensors)))
            by_intrinsics = torch.func.jacrev(call, order)(values[-1], *tensors)
            expected = torch.autograd.functional.jacobian(partial(call, values[-1]), tuple(tensors))
            for found, wanted in zip(by_intrinsics, expected, strict=True):
                torch.testing.assert_close(found, wanted, **close)


class Both(nn.Module):
    """Both directions of a camera as one module."""

    def __init__(self, camera: Camera) -> None:
        super().__init__()
        self.camera = camera

    def forward(self, points: Tensor, pixels: Tensor) -> tuple[Tensor, ...]:
        return (*self.camera.project(points), *self.camera.unproject(pixels))


def _traced_equals_eager(camera: Camera, traced: Callable[..., tuple[Tensor, ...]]) -> None:
    points = telling_directions(camera).to(camera.dtype)
    pixels = camera.project(points).pixels
    for found, wanted in zip(traced(points, pixels), Both(camera)(points, pixels), strict=True):
        torch.testing.assert_close(found, wanted, rtol=1e-12, atol=1e-10)


def compiles_without_graph_breaks(camera: Camera, backend: str) -> None:
    """``torch.compile(fullgraph=True)`` of both directions gives what eager does."""
    torch._dynamo.reset()
    _traced_equals_eager(camera, torch.compile(Both(camera), fullgraph=True, backend=backend))


def compiled_gradients(camera: Camera, backend: str) -> None:
    """Compiled derivatives, too."""
    torch._dynamo.reset()
    points = telling_directions(camera).to(camera.dtype).requires_grad_()
    pixels = camera.project(points).pixels.detach().requires_grad_()
    both = Both(camera)
    gradients = []
    for run in (both, torch.compile(both, fullgraph=True, backend=backend)):
        answers = run(points, pixels)
        total = answers[0].square().sum() + (answers[2] * torch.tensor([1.0, 2.0, 3.0])).sum()
        gradients.append(torch.autograd.grad(total, (points, pixels)))
    for found, wanted in zip(*gradients, strict=True):
        torch.testing.assert_close(found, wanted, rtol=1e-9, atol=1e-9)


def exports(camera: Camera) -> None:
    """``torch.export`` of both directions, for any number of points."""
    points = telling_directions(camera).to(camera.dtype)
    pixels = camera.project(points).pixels
    number = torch.export.Dim("number", min=2, max=10**6)
    program = torch.export.export(Both(camera), (points, pixels), dynamic_shapes=({0: number}, {0: number}))
    _traced_equals_eager(camera, program.module())


def law_gradients_are_right(camera: Camera) -> None:
    """Finite differences in float64 with respect to points, pixels and intrinsics, on the axis too."""
    camera = camera.to(torch.float64)
    changes = [torch.zeros_like(tensor, requires_grad=True) for tensor in intrinsics_of(camera)[1]]
    seen = directions_seen(camera)
    axis = seen.new_tensor([[0.0, 0.0, 1.0], [0.0, 0.0, 2.5]])
    points = torch.cat((axis, seen[:: len(seen) // 5])).requires_grad_()
    pixels = camera.project(points.detach()).pixels.requires_grad_()
    for verb, values in zip(BOTH, (points, pixels), strict=True):
        call = _function(camera, verb)
        assert torch.autograd.gradcheck(call, (values, *changes), eps=1e-6, atol=2e-4, rtol=1e-4)
