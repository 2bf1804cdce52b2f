# SPDX-License-Identifier: Apache-2.0
"""RayPackets leave nothing out: depth and shadows against every ray tested with every primitive, in float64."""

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from sphericalvision.cameras import Camera, EquirectangularCamera, FisheyeCamera
from sphericalvision.scenes.procedural import make_scene
from sphericalvision.scenes.registry import scene_kinds
from sphericalvision.scenes.rendering.primitives import SHAPES, Part, Primitives
from sphericalvision.scenes.rendering.ray_packets import RAYS, RayPackets, candidate_pairs, packed
from sphericalvision.scenes.rendering.raycast import first_hits
from sphericalvision.scenes.rendering.render import ray_depth, render_camera, render_directions
from sphericalvision.scenes.rendering.scene import Lamp
from sphericalvision.scenes.rendering.shading import SHADOW_GAP, SurfaceSamples, irradiance, normals_and_uv
from tests.scenes.test_raycast import in_double, packets
from tests.scenes.test_scenes import plain

ORIGIN = torch.zeros(3)


def dense(primitives: Primitives, origins: Tensor, directions: Tensor) -> Tensor:
    """Distances ``(P, n)`` to every primitive, one at a time, by textbook formulas in float64; inf where missed."""
    table, distances = in_double(primitives), []
    for row in range(len(table)):
        frame = table.rotation[row] / table.half[row][:, None]
        o, d = (origins.double() - table.center[row]) @ frame.T, directions.double() @ frame.T
        shape = SHAPES[int(table.shape[row])]
        if shape == "rectangle":
            time = -o[..., 2] / d[..., 2]
            on = (o + time[:, None] * d)[:, :2].abs().amax(-1) <= 1
            distances.append(torch.where(on & (time > 1e-4), time, torch.inf))
            continue
        enter, leave = torch.full_like(d[:, 0], -torch.inf), torch.full_like(d[:, 0], torch.inf)
        slabs = {"box": (0, 1, 2), "ellipsoid": (), "cylinder": (1,)}[shape]
        for axis in slabs:
            ends = torch.stack([(side - o[..., axis]) / d[:, axis] for side in (-1, 1)])
            enter, leave = torch.maximum(enter, ends.amin(0)), torch.minimum(leave, ends.amax(0))
        round_axes = [axis for axis in range(3) if axis not in slabs]
        if shape != "box":
            o, d = o[..., round_axes].expand(len(d), -1), d[:, round_axes]
            a, b, c = (d * d).sum(-1), (o * d).sum(-1), (o * o).sum(-1) - 1
            root = (b * b - a * c).sqrt()  # nan where missed
            enter, leave = torch.maximum(enter, (-b - root) / a), torch.minimum(leave, (-b + root) / a)
        first = torch.where(enter > 1e-4, enter, leave)
        distances.append(torch.where((enter <= leave) & (leave > 1e-4), first, torch.inf))
    return torch.stack(distances)


def rays(camera: Camera) -> Tensor:
    seen = camera.unproject(camera.pixel_grid())
    return seen.directions[seen.valid]


@pytest.mark.parametrize("kind", scene_kinds())
def test_depth_is_that_of_testing_everything(kind: str) -> None:
    scene = make_scene(kind, 3)
    directions = rays(FisheyeCamera.from_field_of_view((64, 64), math.radians(220)))
    origin = torch.tensor([0.2, 0.0, 0.1])
    expected = dense(scene.primitives, origin, directions).amin(0)
    depth = ray_depth(scene, origin, directions)
    close = torch.isclose(depth.double(), expected, rtol=1e-4, atol=1e-4)
    assert close.float().mean() > 0.999  # rays through edges, by rounding


@pytest.mark.parametrize("kind", scene_kinds())
@pytest.mark.parametrize("seed", [0, 5])
def test_light_is_that_of_tracing_every_shadow_ray(kind: str, seed: int) -> None:
    """Points as a camera sees them, in its packets: most on several primitives."""
    scene = make_scene(kind, seed)
    columns = packed(rays(FisheyeCamera.from_field_of_view((48, 48), math.radians(200))).T.contiguous())
    distance, row = first_hits(scene.primitives, RayPackets(ORIGIN[:, None, None], columns))
    met = row >= 0
    position = distance.masked_fill(~met, 1.0) * columns
    # Any normal will do; half of the points turn away from a lamp. Their inner side: nothing is left out.
    lamp = next(iter(scene.lamps.position), ORIGIN)  # a patchwork may have none
    normal = torch.nn.functional.normalize(lamp[:, None, None] - position, dim=0)
    normal = torch.where((torch.arange(RAYS) % 2 == 0), normal, -columns)
    side = -1 - row.clamp(min=0)
    light = irradiance(scene, SurfaceSamples(position, normal, side)).flatten(1).T.double()
    points, normals = (x.flatten(1).T.double() for x in (position, normal))
    expected = scene.ambient.double() * (1 - 0.25 * normals[:, 1:2])
    for place, color, reach in zip(
        scene.lamps.position.double(), scene.lamps.color.double(), scene.lamps.reach.double(), strict=True
    ):
        away = (points - place).norm(dim=-1)
        ray = (points - place) / away[:, None]
        clear = dense(scene.primitives.shadow_casters, place, ray).amin(0) >= away - SHADOW_GAP
        slant = -(normals * ray).sum(-1).clamp(max=0)
        expected = expected + (clear * slant / (reach**2 + away**2))[:, None] * color
    same = torch.isclose(light, expected, rtol=1e-3, atol=1e-4).all(-1)[met.flatten()]
    assert same.float().mean() > 0.995


@pytest.mark.parametrize("kind", scene_kinds())
def test_leaving_out_the_own_primitive_changes_no_light(kind: str) -> None:
    """The shadow that a convex primitive throws on itself is where it turns away from the lamp."""
    scene = make_scene(kind, 2)
    down, across = torch.meshgrid(torch.arange(16), torch.arange(16), indexing="ij")
    square = torch.stack([across - 7.5, down - 7.5, torch.full((16, 16), 60.0)], -1).reshape(1, RAYS, 3)
    turns = torch.linalg.qr(torch.randn(100, 3, 3, generator=torch.Generator().manual_seed(0)))[0]
    columns = torch.nn.functional.normalize(square @ turns, dim=-1).permute(2, 0, 1).contiguous()
    distance, row = first_hits(scene.primitives, RayPackets(ORIGIN[:, None, None], columns))
    met = row >= 0
    distance, row = distance.masked_fill(~met, 1.0), row.clamp(min=0)
    position = distance * columns
    normal, _, inner = normals_and_uv(
        scene.primitives, position.flatten(1), columns.flatten(1), row.flatten()
    )
    normal, nothing = normal.view_as(position), -1 - row
    side = torch.where(inner.view_as(row), nothing, row)
    own, none = (irradiance(scene, SurfaceSamples(position, normal, x)) for x in (side, nothing))
    assert torch.isclose(own, none, rtol=1e-4).all(0)[met].float().mean() > 0.999


def lit_box(camera_at: Tensor) -> Tensor:
    scene = plain([Part("box", (0.0, 0.0, 0.0), (1.0, 1.0, 1.0))], [Lamp((0.0, -3.0, 0.0), (5.0, 5.0, 5.0))])
    angle = torch.linspace(-0.2, 0.2, 400)
    directions = torch.stack([angle.sin(), angle.cos(), torch.zeros(400)], -1)
    return render_directions(scene, camera_at, directions)


def test_a_box_is_dark_inside_and_lit_outside() -> None:
    """From within, the floor faces the lamp, but the lid of the same primitive is between."""
    assert (lit_box(torch.tensor([0.0, 0.0, 0.0])) == 0).all()
    assert (lit_box(torch.tensor([0.0, -2.0, 0.0])) > 0.3).all()


def test_bundles_that_start_anywhere_meet_what_their_rays_meet(generator: torch.Generator) -> None:
    primitives = make_scene("room", 1).primitives
    directions = torch.nn.functional.normalize(
        torch.tensor([0.3, 0.2, 1.0]) + 0.2 * torch.randn(4 * RAYS, 3, generator=generator), dim=-1
    )
    origins = torch.rand(4 * RAYS, 3, generator=generator) - 0.5
    met = dense(primitives, origins, directions).isfinite().view(len(primitives), 4, RAYS).any(-1)
    pairs = candidate_pairs(primitives, packets(origins, directions))
    possible = torch.zeros_like(met)
    possible[primitives.columns.order[pairs.place], pairs.packet] = True
    assert not (met & ~possible).any()
    assert possible.float().mean() < 0.9


@pytest.mark.parametrize(
    "camera",
    [
        *map(EquirectangularCamera, [(5, 7), (17, 33), (32, 48)]),
        FisheyeCamera.from_field_of_view((48, 48), 3.5),
    ],
    ids=repr,
)
def test_pictures_are_what_their_rays_see_whatever_the_camera_and_its_size(camera: Camera) -> None:
    scene = make_scene("room", 5)
    # Without textures, that depend on the pixels' size.
    scene = replace(scene, materials=replace(scene.materials, dark=scene.materials.bright))
    picture = render_camera(scene, camera, torch.eye(4))[:, camera.unproject(camera.pixel_grid()).valid]
    alone = render_directions(scene, ORIGIN, rays(camera))
    assert ((picture - alone).abs().amax(0) < 1e-3).float().mean() > 0.99


def test_no_rays_no_picture() -> None:
    scene = make_scene("floating", 0)
    assert render_directions(scene, ORIGIN, torch.zeros(0, 3)).shape == (3, 0)
    assert ray_depth(scene, ORIGIN, torch.zeros(2, 0, 3)).shape == (2, 0)
