# SPDX-License-Identifier: Apache-2.0
"""Tables of a sphere sweep against one ray at a time: ``locate``, and angles from the axes."""

from __future__ import annotations

import math

import pytest
import torch

from sphericalvision.cameras import CameraRig, ring_rig
from sphericalvision.geometry import transform_from_axis_angle
from sphericalvision.icosphere import Icosphere, icosphere_vertices, locate
from sphericalvision.kernels import kernels, reference_kernels
from sphericalvision.sweep import PanoramaSweep, SphereSweep, SweepTables, inverse_depth_hypotheses
from sphericalvision.sweep.sweep_tables import sweep_tables

DOUBLE = torch.float64


def shaken_rig(generator: torch.Generator, field_of_view: float, dtype: torch.dtype = DOUBLE) -> CameraRig:
    rig = ring_rig(3, field_of_view=field_of_view, image_size=(64, 64)).to(dtype=dtype)
    wobble = torch.randn(2, 3, 3, dtype=DOUBLE, generator=generator).to(dtype)
    return CameraRig(
        rig.cameras, rig.world_from_camera @ transform_from_axis_angle(0.3 * wobble[0], 0.05 * wobble[1])
    )


def rays_of(sweep: SphereSweep, rig: CameraRig) -> torch.Tensor:
    """Rays ``(N, V, n, 3)``."""
    offsets = rig.center - rig.positions
    return sweep.directions[:, None] + sweep.inverse_depths[:, None, None, None] * offsets


@pytest.mark.parametrize("degrees", [2, 40, 180, 220, 358, 360])
def test_in_view_by_angle(degrees: float, generator: torch.Generator) -> None:
    rig = shaken_rig(generator, math.radians(degrees))
    sweep = SphereSweep(3, 5, 0.5)
    rays, axes = rays_of(sweep, rig), rig.axes.expand(5, 642, 3, 3)
    angles = torch.atan2(torch.linalg.cross(axes, rays).norm(dim=-1), (axes * rays).sum(-1))
    assert torch.equal(sweep.tables(rig).seen, angles <= rig.max_angles)


def test_a_network_in_half_precision_sweeps_the_same_points() -> None:
    rig = ring_rig(3, image_size=(64, 64))
    exact, half = (SphereSweep(3, 5, 0.5).to(kind).tables(rig) for kind in (torch.float32, torch.float16))
    torch.testing.assert_close(half, exact)
    exact, half = (
        PanoramaSweep((4, 8), 4, 0.5).to(kind).tables(rig) for kind in (torch.float32, torch.float16)
    )
    torch.testing.assert_close(half, exact)


@pytest.mark.parametrize("dtype", [torch.float32, DOUBLE])
def test_half_a_turn_ends_at_the_poles_and_includes_them(dtype: torch.dtype) -> None:
    """Both poles are at right angles to the axes of a level rig."""
    tables = SphereSweep(2, 2, 0.5).tables(ring_rig(4, field_of_view=math.pi).to(dtype=dtype))
    assert tables.seen[0, [0, -1]].all()


@pytest.mark.parametrize("way", ["plain", "graph"])
@pytest.mark.parametrize("level", [2, 4])
def test_ids_and_weights_are_those_of_locate(level: int, way: str, generator: torch.Generator) -> None:
    rig, sweep = shaken_rig(generator, 3.8), SphereSweep(2, 6, 0.5, feature_level=level)
    with kernels(way):
        ids, weights, mask = sweep.tables(rig)
    with reference_kernels():
        found, shares = locate(rays_of(sweep, rig)[1:][mask[1:]], level)  # at infinity are vertices
    assert torch.equal(ids[1:][mask[1:]], found)
    torch.testing.assert_close(weights[1:][mask[1:]], shares)
    assert not ids[~mask].any()
    assert not weights[~mask].any()


def test_float32_is_as_exact_as_its_rays(generator: torch.Generator) -> None:
    rig, sweep = shaken_rig(generator, 3.8, torch.float32), SphereSweep(4, 4, 0.5)
    ids, weights, mask = sweep.tables(rig)
    assert weights.dtype == torch.float32
    rebuilt = (Icosphere(4, DOUBLE).vertices[ids] * weights[..., None]).sum(-2)[mask]
    rays = rays_of(sweep, rig.to(dtype=DOUBLE))[mask]
    torch.testing.assert_close(
        torch.nn.functional.normalize(rebuilt, dim=-1),
        torch.nn.functional.normalize(rays, dim=-1),
        rtol=0,
        atol=5e-7,
    )


@pytest.mark.parametrize("size", [1, 100, 500, 1500, 4000])
def test_blocks_change_nothing(
    size: int, generator: torch.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    """162 vertices of three cameras: by a few vertices, by one hypothesis, by several."""
    rig, sweep = shaken_rig(generator, 3.8), SphereSweep(2, 7, 0.5)
    expected = sweep.tables(rig)
    monkeypatch.setattr("sphericalvision.icosphere.locator.chunk_size", lambda device: size)
    for mine, whole in zip(sweep.tables(rig), expected, strict=True):
        assert torch.equal(mine, whole)


def test_weights_are_the_same_with_gradients(generator: torch.Generator) -> None:
    rigs = CameraRig.stack([shaken_rig(generator, 3.8) for _ in range(2)])
    sweep = SphereSweep(2, 4, 0.5)
    expected = sweep.tables(rigs)
    assert expected.ids.shape == (2, 4, 162, 3, 3)
    poses = rigs.world_from_camera.clone().requires_grad_()
    tables = sweep.tables(CameraRig(rigs.cameras, poses))
    for mine, plain in zip(tables, expected, strict=True):
        torch.testing.assert_close(mine, plain)
    (tables.weights[:, 1:] * icosphere_vertices(2, DOUBLE)[tables.ids[:, 1:]][..., 0]).sum().backward()
    assert poses.grad is not None
    assert poses.grad.isfinite().all()
    assert poses.grad[..., :3, 3].abs().min() > 0


class TablesOfOneRig(torch.nn.Module):
    """The tables of a rig that is part of the program, and where they look."""

    def __init__(self) -> None:
        super().__init__()
        self.rig, self.sweep = ring_rig(2, field_of_view=3.8), SphereSweep(1, 2, 0.5)

    def forward(self, offset: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        ids, weights, mask = self.sweep.tables(self.rig)
        return (self.sweep.directions[ids] * weights[..., None]).sum(-2) + offset, mask


def test_a_program_with_a_rig_inside_can_be_exported() -> None:
    module, offset = TablesOfOneRig(), torch.ones(3)
    program = torch.export.export(module, (offset,))
    torch.testing.assert_close(program.module()(offset), module(offset), rtol=0, atol=1e-6)


def test_nothing_in_view() -> None:
    rig = ring_rig(2, field_of_view=1e-3).to(dtype=DOUBLE)
    sideways = torch.tensor([[0.0, 1.0, 0.0], [0.0, -1.0, 0.0]], dtype=DOUBLE)
    tables = sweep_tables(sideways, inverse_depth_hypotheses(3, 0.5), rig, 2)
    assert isinstance(tables, SweepTables)
    assert not any(table.any() for table in tables)
    assert tables.weights.shape == (3, 2, 2, 3)
