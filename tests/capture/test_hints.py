# SPDX-License-Identifier: Apache-2.0
"""Hints as people have them: points, depth images, panoramas, the last frame; in metres or not; wrong ones."""

from __future__ import annotations

import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from sphericalvision import Predictor
from sphericalvision.cameras import CameraRig, ring_rig
from sphericalvision.capture import Depth, Hint
from sphericalvision.capture.hint_files import HintFiles
from sphericalvision.capture.hints import with_hint
from sphericalvision.core import ArgumentError, ArgumentTypeError, FileFormatError
from sphericalvision.geometry import transform_from_axis_angle
from sphericalvision.icosphere import Icosphere
from sphericalvision.io.images import write_pages
from sphericalvision.models import WinnerTakesAll
from sphericalvision.scenes import make_scene, ray_depth, render_rig
from sphericalvision.sphere import Equirectangular
from sphericalvision.sphere.resampling.views import Views
from sphericalvision.sweep import index_from_depth

SCENE, GRID = make_scene("room", seed=4), Icosphere(5)


def rig_of_four() -> CameraRig:
    return ring_rig(4, image_size=(150, 160))


def true_depth(rig: CameraRig) -> Tensor:
    return ray_depth(SCENE, rig.center, GRID.vertices)


def depth_images(rig: CameraRig) -> dict[str, Tensor]:
    """Metres along the rays, 0 where lenses show nothing."""
    images = {}
    for (name, camera), pose in zip(rig.cameras.items(), rig.world_from_camera, strict=True):
        rays, seen = camera.unproject(camera.pixel_grid(torch.float32))
        images[name] = torch.zeros(1, *camera.image_size)
        images[name][0, seen] = ray_depth(SCENE, pose[:3, 3], rays[seen] @ pose[:3, :3].T)
    return images


def answer(rig: CameraRig, factor: float = 1.0) -> Depth:
    """What a network would say that has the true depth, or a multiple of it."""
    net = WinnerTakesAll(5, 64, 0.3, depth_coarsening=0)
    ones = torch.ones(GRID.num_vertices)
    return Depth(index_from_depth(factor * true_depth(rig), 64, 0.3), ones, ones > 0, net, rig, {})


def translated(rig: CameraRig, by: Tensor) -> CameraRig:
    moved = transform_from_axis_angle(torch.zeros(3), by) @ rig.world_from_camera
    return rig.replaced(world_from_camera=moved)


def error(hint: Any, rig: CameraRig) -> tuple[float, float]:
    """Median relative error of a hint on vertices, and the share of them that have one."""
    inverse_depth, weight = hint
    known = weight > 0
    return float((inverse_depth * true_depth(rig) - 1).abs()[known].median()), float(known.float().mean())


def test_points_and_panoramas_are_told_from_the_centre() -> None:
    rig = rig_of_four()
    points = rig.center + true_depth(rig)[::50, None] * GRID.vertices[::50]
    points = torch.cat((points, torch.tensor([[torch.nan, 0.0, 1.0], [0.0, 0.0, 0.0]])))
    off, share = error(Hint.of_points(points, 0.5).on(GRID, rig), rig)
    assert off < 1e-4
    assert share == pytest.approx(1 / 50, rel=0.05)
    moved = translated(rig, torch.ones(3))
    hint = Hint.of_points(points[:-2] + 1).on(GRID, moved)
    assert error(hint, rig)[0] < 1e-4
    scaled = Hint.of_points(0.4 * (points[:-2] - rig.center), fit="scale")  # counted from where the rig is
    assert error(scaled.on(GRID, moved, answer(rig)), rig)[0] < 0.01
    grid = Equirectangular(160, 320)
    panorama = ray_depth(SCENE, rig.center, grid.directions.reshape(-1, 3)).view(grid.shape)
    off, share = error(Hint.of_directions(grid.directions, 1 / panorama).on(GRID, rig), rig)
    assert off < 0.01
    assert share > 0.99


@pytest.mark.parametrize(
    ("quantity", "fit"),
    [("range", "metres"), ("z", "scale"), ("range", "scale"), ("range", "affine"), ("z", "affine")],
)
def test_depth_images_stand_where_their_cameras_stand_and_are_fitted_each(quantity: Any, fit: Any) -> None:
    rig = ring_rig(4, image_size=(150, 160), field_of_view=2.6).rotated(tilt=0.3)
    images = depth_images(rig)
    for number, (name, camera) in enumerate(rig.cameras.items()):
        rays = camera.unproject(camera.pixel_grid(torch.float32)).directions
        values = images[name].where(images[name] > 0, torch.nan)
        if quantity == "z":
            values = values * rays[..., 2]
        if fit == "scale":
            values = values * (0.5, 1.0, 2.0, 9.0)[number]
        if fit == "affine":
            values = (1 / values + 0.1 * number) * (0.5, 1.0, 2.0, 9.0)[number]
        images[name] = values if fit == "affine" else values.nan_to_num(0)
    hint = Hint.of_views(Views(images, rig), quantity, fit)
    off, share = error(hint.on(GRID, rig, answer(rig)), rig)
    assert off < 0.02
    assert share > 0.7
    if fit != "metres":
        off, _ = error(hint.on(GRID, rig, answer(rig, 1.3)), rig)
        assert off == pytest.approx(1 - 1 / 1.3, abs=0.05)
        with pytest.raises(ArgumentError, match="answer: expected that of the network"):
            hint.on(GRID, rig)


def test_views_at_the_origin_stand_at_the_centre_and_masks_count() -> None:
    rig = rig_of_four()
    poses = rig.world_from_camera.clone()
    poses[:, :3, 3] = 0
    center = rig.replaced(world_from_camera=poses)
    images = depth_images(center)
    there = translated(rig, rig.center + torch.tensor([5.0, 0.0, 2.0]))
    inverse_depth, weight = Hint.of_views(Views(images, center)).on(GRID, there)
    assert error((inverse_depth, weight), rig)[0] < 0.02
    masks = {name: torch.zeros(150, 160, dtype=torch.bool) for name in rig.names[1:]}
    masked = Hint.of_views(Views(images, center.replaced(masks=masks))).on(GRID, there)
    seen = GRID.vertices[masked.weight[0] > 0]
    assert 0.3 < len(seen) / GRID.num_vertices < 0.75
    assert (seen[:, 2] > -0.5).all()  # of the camera in front


def relative_error(depth: Depth, rig: CameraRig) -> float:
    return float((depth.inverse_depth * true_depth(rig) - 1).abs().mean())


def test_the_last_frame_is_carried_on_by_the_pose() -> None:
    rig = rig_of_four()
    motion = transform_from_axis_angle(torch.tensor([0.0, 0.3, 0.0]), torch.tensor([0.1, 0.0, -0.3]))
    moved = rig.replaced(world_from_camera=motion @ rig.world_from_camera)
    off = answer(rig, 1.01)
    alone = relative_error(off, rig)
    assert alone == pytest.approx(1 - 1 / 1.01, abs=1e-3)
    carried = Hint.of_depth(answer(moved), torch.eye(4)).averaged(off)  # both in one world
    assert relative_error(carried, rig) < 0.65 * alone
    there, here = (torch.tensor(place).double() for place in ((4e5, 0.0, 5e6), (4e5 + 7, 0.0, 5e6 - 3)))
    shifted = replace(answer(moved), rig=moved.replaced(origin=there))  # the same world, seen from two places
    now = rig.replaced(world_from_camera=rig.world_from_camera.clone(), origin=here)
    now.world_from_camera[:, :3, 3] += (there - here).float()
    one_world = Hint.of_depth(shifted, torch.eye(4)).averaged(replace(off, rig=now))
    torch.testing.assert_close(one_world.index, carried.index, rtol=0, atol=1e-3)
    home = torch.eye(4).double()
    home[:3, 3] = -there
    own_world = Hint.of_depth(shifted, home).averaged(off)
    torch.testing.assert_close(own_world.index, carried.index, rtol=0, atol=1e-3)
    # As if it had moved the other way
    back = Hint.of_depth(answer(moved), torch.linalg.inv(motion)).averaged(off)
    assert relative_error(back, rig) > 0.75 * alone
    forward = torch.tensor([0.1, 0.0, -0.3])
    straight = transform_from_axis_angle(torch.zeros(3), forward)
    own = replace(answer(translated(rig, forward)), rig=rig)
    for pose, limits in ((straight, (0, 0.65)), (torch.eye(4), (0.75, 2))):  # frames in the world of each rig
        error_of_mean = relative_error(Hint.of_depth(own, pose).averaged(off), rig)
        assert limits[0] * alone <= error_of_mean < limits[1] * alone


def test_frames_are_averaged_and_what_moved_is_forgotten() -> None:
    rig, generator = rig_of_four(), torch.Generator().manual_seed(0)
    true = answer(rig)

    def noisy(change: Tensor | float = 0.0) -> Depth:
        index = true.index + 0.05 * torch.randn(true.index.shape, generator=generator) + change
        return replace(true, index=index)

    last = noisy()
    for _ in range(12):
        last = Hint.of_depth(last, torch.eye(4)).averaged(noisy())
    deviation = float((last.index - true.index).std())
    assert deviation < 0.4 * 0.05  # sqrt(0.15 / 1.85) = 0.28, and edges
    there = GRID.vertices[:, 2] > 0.8
    after = Hint.of_depth(last, torch.eye(4)).averaged(noisy(4.0 * there))
    assert float((after.index - true.index - 4)[there].abs().mean()) < 0.05
    assert float((after.index - true.index)[~there].std()) < 0.4 * 0.05
    unsure = replace(noisy(), confidence=torch.zeros_like(true.confidence))
    kept = Hint.of_depth(last, torch.eye(4)).averaged(unsure)
    torch.testing.assert_close(kept.index, last.index, rtol=0, atol=0.01)
    guess = replace(true, index=true.index + 16.0 * there, confidence=torch.full_like(true.confidence, 0.5))
    first = Hint.of_depth(last, torch.eye(4)).averaged(guess)  # unsure: a guess, until it is repeated
    torch.testing.assert_close(first.index[there], last.index[there], rtol=0, atol=0.01)
    again = Hint.of_depth(first, torch.eye(4)).averaged(guess)
    assert float((again.index - guess.index).abs()[there].quantile(0.95)) < 0.3
    infinite = Hint.of_depth(last, torch.eye(4)).averaged(replace(true, index=0 * true.index))
    assert not infinite.index.any()
    batch = replace(true, index=true.index[None], confidence=true.confidence[None], seen=true.seen[None])
    for call in (
        lambda: Hint.of_depth(batch, torch.eye(4)),
        lambda: Hint.of_depth(true, torch.eye(4)).averaged(batch),
    ):
        with pytest.raises(ArgumentError, match="depth: expected that of one frame"):
            call()


def test_infinite_pixels_say_nothing(tmp_path: Path) -> None:
    rig = ring_rig(2, image_size=(36, 40))
    true = {name: torch.randint(2000, 3000, (1, 36, 40)) / 1000 for name in rig.names}
    known = {name: torch.rand(1, 36, 40) > 0.3 for name in rig.names}
    zero, infinite = (
        {name: image.where(known[name], unknown) for name, image in true.items()}
        for unknown in (0, torch.inf)
    )
    expected = Hint.of_views(Views(zero, rig)).on(GRID, rig)
    found = Hint.of_views(Views(infinite, rig)).on(GRID, rig)
    torch.testing.assert_close(found, expected, rtol=0, atol=0)
    for name in rig.names:
        millimetres = (1000 * zero[name][0]).round().where(known[name][0], 65535)
        write_pages(tmp_path / f"{name}0.png", [millimetres.numpy().astype(np.uint16)])
    panorama = torch.full((16, 32), 3.0)
    panorama[:8] = torch.inf
    write_pages(tmp_path / "0.tiff", [panorama.numpy()])
    read = HintFiles(str(tmp_path / "{camera}{frame}.png"), ["0"], rig, torch.eye(4))("0")
    assert torch.equal(read.on(GRID, rig).weight, expected.weight)
    around = HintFiles(str(tmp_path / "{frame}.tiff"), ["0"], rig, torch.eye(4))("0").views[0]
    torch.testing.assert_close(around.values, torch.full((8 * 32,), 1 / 3))
    nowhere = Hint.of_directions(torch.tensor([[0.0, 0.0, 0.0], [0.0, 0.0, 2.0]]), torch.ones(2))
    assert nowhere.views[0].rays.tolist() == [[0.0, 0.0, 1.0]]


def test_points_of_a_map_or_in_millimetres_are_no_metres_from_the_rig() -> None:
    survey = GRID.vertices[:50] + torch.tensor([450_000.0, 5_200_000.0, 430.0])
    for points in (survey, 2000 * GRID.vertices):
        with pytest.raises(ArgumentError, match="hint: expected metres"):
            Hint.of_points(points)
        Hint.of_points(points, fit="scale")


def test_points_in_files_are_in_the_frame_of_the_calibration(tmp_path: Path) -> None:
    """Wherever that was placed, and however far away the world is."""
    turn, place = torch.tensor([[0.2, -0.5, 0.1], [3e5, -20, 6e5]], dtype=torch.float64)
    placement = transform_from_axis_angle(turn, place)
    rig = rig_of_four().replaced(origin=place.round())
    points = true_depth(rig)[:, None] * GRID.vertices + rig.origin
    np.save(tmp_path / "0.npy", ((points - place) @ placement[:3, :3]).numpy())
    hint = HintFiles(str(tmp_path / "{frame}.npy"), ["0"], rig, placement)("0")
    off, share = error(hint.on(GRID, rig), rig)
    assert off < 1e-3
    assert share > 0.99


def test_arrays_in_files_are_read_in_either_byte_order_or_the_file_is_named(tmp_path: Path) -> None:
    rig = ring_rig(2, image_size=(8, 8))
    rays = GRID.vertices[:50].numpy()
    arrays = {"directions": rays, "inverse_depth": np.linspace(0.1, 2, 50)}
    arrays["confidence"] = np.ones(50, np.float32)

    def read(name: str) -> Hint:
        return HintFiles(str(tmp_path / name), ["0"], rig, torch.eye(4))("0")

    for order in "<>":
        ordered = {key: values.astype(values.dtype.newbyteorder(order)) for key, values in arrays.items()}
        np.savez(tmp_path / f"{order}.npz", **ordered)
        np.save(tmp_path / f"{order}.npy", rays.astype(f"{order}f8"))
        depth = np.full((4, 8), 2500).astype(f"{order}u2")
        np.save(tmp_path / f"{order}d.npy", np.tile(depth, (4, 4)))
    for name in ("{}.npz", "{}.npy", "{}d.npy"):
        little, big = (read(name.format(order)).views[0] for order in "<>")
        assert torch.equal(little.rays, big.rays)
        assert torch.equal(little.values, big.values)
    for key, wrong in (
        ("directions", rays[:, :2]),
        ("inverse_depth", np.ones(9)),
        ("confidence", np.full(50, "x")),
    ):
        np.savez(tmp_path / "wrong.npz", **{**arrays, key: wrong})
        with pytest.raises(FileFormatError, match=r"wrong\.npz: "):
            read("wrong.npz")
    for name in rig.names:
        np.save(tmp_path / f"{name}.npy", np.ones((9, 16)))
    with pytest.raises(FileFormatError, match=r"cam1\.npy: expected 8 x 8 .*, got 16 x 9"):
        read("{camera}.npy")


def test_views_that_agree_with_nothing_are_left_out() -> None:
    rig = rig_of_four()
    images = depth_images(rig)
    generator = torch.Generator().manual_seed(0)
    images["cam3"] = (3 * torch.randn(1, 150, 160, generator=generator)).exp()
    with pytest.warns(UserWarning, match="hint: view 3 of 4 is left out"):
        hint = Hint.of_views(Views(images, rig), fit="scale").on(GRID, rig, answer(rig))
    assert error(hint, rig)[0] < 0.02
    every = dict.fromkeys(rig.names, images["cam3"])
    with (
        pytest.warns(UserWarning, match="is left out"),
        pytest.raises(ArgumentError, match="hint: no view of it agrees"),
    ):
        Hint.of_views(Views(every, rig), fit="scale").on(GRID, rig, answer(rig))


def test_a_predictor_takes_hints_and_says_if_one_is_of_another_frame() -> None:
    rig = rig_of_four()
    images = render_rig(SCENE, rig, 1)
    predictor = Predictor(rig, level=5, min_depth=0.55)
    true = true_depth(rig)

    def mean_error(depth: Depth) -> float:
        return float((depth.inverse_depth - 1 / true).abs().mean())

    points = rig.center + true[::3, None] * GRID.vertices[::3]
    plain, hinted = predictor(images), with_hint(predictor, images, Hint.of_points(points))
    assert mean_error(hinted) < 0.8 * mean_error(plain)
    scaled = with_hint(predictor, images, Hint.of_points(points * 7, fit="scale"))
    assert mean_error(scaled) < 0.9 * mean_error(plain)
    # However little it is off: a hint without an effect is one with a warning
    for factor in (0.3, 0.83, 1.32):
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            wrong = with_hint(predictor, images, Hint.of_points(points * factor))
        unused = torch.equal(wrong.index, plain.index)
        assert unused or factor != 0.3
        assert not unused or [w for w in caught if "counts with 0.00 of its weight" in str(w.message)]
    near = Hint.of_points(points).on(GRID, predictor.rig)
    double = near._replace(weight=near.weight.double())
    torch.testing.assert_close(predictor(images, double).index, hinted.index)
    for bad, message in (
        (near._replace(weight=near.weight.numpy()), "hint.weight: expected a torch.Tensor"),
        (near._replace(weight=2 * near.weight), "hint: expected weights from 0 to 1"),
        (near._replace(inverse_depth=near.inverse_depth * torch.nan), "hint: expected weights from 0 to 1"),
    ):
        with pytest.raises((ArgumentError, ArgumentTypeError), match=message):
            predictor(images, bad)
    batch = {name: image[None].repeat(2, 1, 1, 1) for name, image in images.items()}
    with pytest.raises(ArgumentError, match="hint: it is of one frame"):
        with_hint(predictor, batch, Hint.of_points(points, fit="scale"))
