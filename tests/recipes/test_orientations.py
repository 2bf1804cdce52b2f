# SPDX-License-Identifier: Apache-2.0
"""Digits and rooms on the sphere, upright and turned: samples, networks that are alike, trainings and their tables."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch

from sphericalvision.core import FileFormatError
from sphericalvision.crown import CrownConv2d, from_crown, hex_conv2d, to_crown
from sphericalvision.data import random_rotations
from sphericalvision.data.augmentation.sphere_rotation import rotate_on_sphere, yaw_on_sphere
from sphericalvision.icosphere import Icosphere
from sphericalvision.models import SphereClassifier, SphereSegmenter
from sphericalvision.models.sphere_blocks import SPHERE_NETWORKS
from sphericalvision.recipes.digits.aligned import AlignedCrownClassifier, AlignedCrownConv2d
from sphericalvision.recipes.digits.dataset import (
    NUM_DIGITS,
    DigitsDataModule,
    SphericalDigits,
    draw_on_sphere,
    load_digits,
)
from sphericalvision.recipes.digits.module import ClassificationModule
from sphericalvision.recipes.segmentation.rooms import (
    ORIENTATIONS,
    LabelledRooms,
    LabelledRoomsDataModule,
    orientation_rotation,
)
from sphericalvision.scenes import make_scene, ray_labels
from sphericalvision.sphere import Equirectangular
from tests.recipes.tiny import Run, typed

TINY = (
    *typed("experiment=spherical_digits model.level=3 model.width=4 data.num_val=8 data.num_test=12"),
    *typed("data.batch_size=4 trainer.max_steps=2 trainer.val_check_interval=1 trainer.accelerator=cpu"),
)


def test_the_digits_are_scikit_learns() -> None:
    images, labels = load_digits()
    assert images.shape == (NUM_DIGITS, 1, 8, 8)
    assert labels.bincount().tolist() == [178, 182, 177, 183, 181, 182, 181, 179, 174, 180]
    assert (images.min(), images.max()) == (0, 1)
    digits = SphericalDigits(range(7, 9), Icosphere(2), "upright", math.radians(120))
    assert [digits[k]["label"] for k in (0, 1)] == labels[7:9].tolist()


def test_a_picture_stands_upright_ahead() -> None:
    """Its middle is forward, its top is up, its right is right; nothing is behind."""
    grid = Equirectangular(91, 181)
    picture = torch.zeros(3, 9, 9)
    picture[0, 4, 4] = picture[1, 1, 4] = picture[2, 4, 7] = 1
    drawn = draw_on_sphere(picture, grid, math.radians(120))
    middle, top, right = (grid.directions.view(-1, 3)[channel.argmax()] for channel in drawn.flatten(1))
    torch.testing.assert_close(middle, torch.tensor([0.0, 0.0, 1.0]), rtol=0, atol=1e-3)
    assert top[1] < -0.3
    assert abs(top[0]) < 1e-3
    assert right[0] > 0.3
    assert abs(right[1]) < 1e-3
    assert (drawn[:, grid.directions[..., 2] < 0.4] == 0).all()


def test_a_rotated_picture_is_the_upright_one_rotated(generator: torch.Generator) -> None:
    grid = Icosphere(5)
    image = torch.nn.functional.interpolate(load_digits()[0][:1], (32, 32), mode="bilinear")[0]
    turn = random_rotations(1, generator=generator)[0]
    drawn = draw_on_sphere(image, grid, math.radians(120), turn)
    moved = rotate_on_sphere(draw_on_sphere(image, grid, math.radians(120)), grid, turn)
    assert (drawn - moved).abs().mean() < 0.01


def test_rotations_are_fixed_in_tests_and_new_in_training() -> None:
    grid = Icosphere(2)
    fixed = SphericalDigits(range(5), grid, "rotated", 2.0, seed=1)
    assert torch.equal(fixed[3]["values"], fixed[3]["values"])
    assert not torch.equal(
        fixed[3]["values"], SphericalDigits(range(5), grid, "rotated", 2.0, 2)[3]["values"]
    )
    new = SphericalDigits(range(5), grid, "rotated", 2.0)
    assert not torch.equal(new[3]["values"], new[3]["values"])
    upright = SphericalDigits(range(5), grid, "upright", 2.0)
    assert torch.equal(upright[3]["values"], upright[3]["values"])


def test_splits_share_no_digit() -> None:
    data = DigitsDataModule(network="hex", level=3, num_val=200, num_test=500)
    numbers = [number for split in ("train", "val", "test") for number in data.indices[split]]
    assert numbers == list(range(NUM_DIGITS))
    assert len(data.indices["train"]) == 1097


@pytest.mark.parametrize("network", SPHERE_NETWORKS)
@pytest.mark.parametrize(
    ("make", "level", "channels", "grouped", "others"),
    [
        (SphereClassifier, 4, 1, 17_800, 47_300),
        (partial(SphereSegmenter, num_classes=6), 3, 3, 27_900, 73_800),
    ],
    ids=["classifier", "segmenter"],
)
def test_networks_are_alike_but_for_their_convolutions(
    make: Callable[..., Any], level: int, channels: int, grouped: int, others: int, network: str
) -> None:
    net = make(network, level=level)
    parameters = sum(parameter.numel() for parameter in net.parameters())
    assert parameters == pytest.approx(grouped if network == "hexgroup" else others, rel=0.02)
    assert math.prod(net.grid.shape) == pytest.approx(10 * 4**level + 2, rel=0.02 if level > 3 else 0.21)
    values = torch.rand(2, channels, *net.grid.shape)
    logits = net(values)
    assert logits.shape == ((2, 10) if channels == 1 else (2, 6, *net.grid.shape))
    logits.sum().backward()
    assert all(parameter.grad is not None for parameter in net.parameters())
    again = type(net)(**net.hyperparameters)
    again.load_state_dict(net.state_dict())
    torch.testing.assert_close(again.eval()(values), net.eval()(values))


@pytest.mark.parametrize("network", ["hex", "hexgroup", "crown"])
def test_a_turn_by_a_fifth_is_nothing_on_the_icosphere(network: str) -> None:
    """Taps turn with the grid about the vertical; the poles, where north is no direction, are out of reach here."""
    net = SphereClassifier(network, level=5).eval()
    digit = draw_on_sphere(load_digits()[0][7], net.grid, math.radians(60))[None]
    torch.testing.assert_close(net(yaw_on_sphere(digit, net.grid, 2)), net(digit), rtol=0, atol=1e-5)


@pytest.mark.parametrize(("network", "invariant"), [("sphere", True), ("planar", False)])
def test_a_turn_by_columns_is_nothing_without_a_seam(network: str, invariant: bool) -> None:
    net = SphereClassifier(network, level=3).eval()
    values = torch.rand(2, 1, *net.grid.shape)
    difference = (net(values.roll(8, -1)) - net(values)).abs().max()  # a multiple of both poolings
    assert (difference < 1e-5) == invariant


@pytest.mark.parametrize(
    "networks", [SPHERE_NETWORKS[:2], pytest.param(SPHERE_NETWORKS, marks=pytest.mark.slow)], ids=len
)
def test_a_sweep_of_networks_ends_with_the_table_of_their_tests(
    run: Run, tmp_path: Path, networks: Sequence[str]
) -> None:
    """The same command as for depth; each run is a row."""
    run("train", "--multirun", *TINY, f"model.network={','.join(networks)}", "hydra.sweep.dir=runs")
    rows = json.loads((tmp_path / "runs/sweep.json").read_text())
    assert [row["model.network"] for row in rows] == list(networks)
    for row in rows:
        folder = tmp_path / "runs" / row["run"]
        (tested,) = json.loads((folder / "test.json").read_text()).values()
        assert tested == {kind: row[f"test {kind}"] for kind in ("upright", "rotated")}
        best = ClassificationModule.stored_network(folder / "checkpoints/best.ckpt")
        assert best.network == row["model.network"]


def test_a_training_is_tested_as_by_a_loop_and_its_weights_start_the_same_network_alone(
    run: Run, failing: Run, tmp_path: Path
) -> None:
    """Enough is learned for numbers above 0, and "min" makes an earlier state the best, which has others."""
    more = "data.batch_size=32 data.num_val=40 data.num_test=40 scheduler=constant optimizer.lr=0.02 task.mode=min"
    steps = "trainer.max_steps=60 trainer.val_check_interval=20"
    run("train", *TINY, *typed(f"{more} {steps}"), "model.network=hex", "output=first")
    best = tmp_path / "first/checkpoints/best.ckpt"
    net = ClassificationModule.stored_network(best).eval()
    data = DigitsDataModule(network="hex", level=3, num_val=40, num_test=40)
    (tested,) = json.loads((tmp_path / "first/test.json").read_text()).values()
    for orientation, percent in tested.items():
        digits = data.samples("test", orientation)
        samples = [digits[i] for i in range(len(digits))]
        right = [int(net(s["values"][None]).argmax() == s["label"]) for s in samples]
        assert percent == pytest.approx(100 * sum(right) / len(right), abs=1e-3)
    still = ("trainer.max_steps=1", "optimizer.lr=0.0")
    run("train", *TINY, *still, "output=second", f"init_weights={best}")
    second = ClassificationModule.stored_network(tmp_path / "second/checkpoints/best.ckpt")
    for name, value in net.named_parameters():
        assert torch.equal(second.get_parameter(name), value), name
    message = failing("train", *TINY, "model.network=crown", f"init_weights={best}")
    assert "network = hex, the network to train has crown" in message


def test_aligned_crowns_convolve_as_hexagons_do_away_from_borders() -> None:
    """``CrownConv2d`` turns its taps in rows, so that it agrees nowhere."""
    values, plain, aligned = torch.randn(1, 1, 642), CrownConv2d(1, 1), AlignedCrownConv2d(1, 1)
    expected = hex_conv2d(values, plain.weight)
    aligned.load_state_dict(plain.state_dict())
    shares = []
    for layer in (aligned, plain):
        off = (from_crown(layer(to_crown(values))) - expected).abs()
        shares.append((off < 1e-5).float().mean())
    assert shares[0] > 0.7 > 0.01 > shares[1]
    net = AlignedCrownClassifier(level=3)
    assert sum(isinstance(layer, AlignedCrownConv2d) for layer in net.modules()) == 4


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04", b"{}"])
def test_damaged_checkpoints_are_told(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "net.ckpt").write_bytes(content)
    with pytest.raises(FileFormatError, match="not a checkpoint of a classifier, or is damaged"):
        ClassificationModule.stored_network(tmp_path / "net.ckpt")


ROOMS = (
    *typed(
        "experiment=segmentation model.level=3 model.width=4 data.num_train=3 data.num_val=1 data.num_test=2"
    ),
    *typed("data.batch_size=2 trainer.max_steps=2 trainer.val_check_interval=1 trainer.accelerator=cpu"),
)


@pytest.mark.parametrize("network", ["hex", "crown", "hexgroup"])
def test_labels_turn_with_the_room(network: str) -> None:
    """A turn by a fifth about the vertical turns the logits; at the poles north is no direction."""
    net = SphereSegmenter(network, level=4).eval()
    values = torch.rand(1, 3, 2562)
    middle = net.grid.directions[:, 1].abs() < 0.6
    turned = yaw_on_sphere(net(values), net.grid, 2)
    difference = (net(yaw_on_sphere(values, net.grid, 2)) - turned).abs()
    assert difference[..., middle].max() < 1e-4


@pytest.mark.parametrize("orientation", ORIENTATIONS)
def test_rooms_are_seen_turned(orientation: str) -> None:
    """Something in direction d of the room is at R d of the sample, and where nothing is, behind a window, is -1."""
    grid = Icosphere(3)
    sample = LabelledRooms(0, 1, grid, orientation)[0]
    turn = orientation_rotation(orientation, 0)
    torch.testing.assert_close(turn @ turn.mT, torch.eye(3), atol=1e-5, rtol=0)
    inverse = torch.linalg.inv(turn)
    seen = torch.stack([inverse @ direction for direction in grid.directions.float()])
    expected = ray_labels(make_scene("room", 0), torch.zeros(3), seen)
    assert (sample["label"] == expected).float().mean() > 0.99
    assert sample["label"].min() == -1
    assert sample["values"].abs().max() <= 1
    down = math.degrees(math.acos(float((turn @ torch.tensor([0.0, 1.0, 0.0]))[1].clamp(-1, 1))))
    tilt = ORIENTATIONS[orientation]
    assert tilt is None or down == pytest.approx(tilt, abs=0.05)


def test_rooms_tilt_to_all_sides() -> None:
    down = torch.stack([orientation_rotation("tilted_90", seed)[:, 1] for seed in range(200)])
    assert down.mean(0).norm() < 0.2


def test_samples_are_kept(tmp_path: Path) -> None:
    rooms = [LabelledRooms(3, 2, Icosphere(2), "tilted_45", str(tmp_path)) for _ in range(2)]
    first = rooms[0][1]
    assert len(list(tmp_path.rglob("*.npz"))) == 1
    assert torch.equal(rooms[1][1]["values"], first["values"])
    assert torch.equal(rooms[1][1]["label"], first["label"])


def test_splits_share_no_room() -> None:
    data = LabelledRoomsDataModule(network="hex", level=3, num_train=400)
    rooms = {split: data.samples(split, "upright") for split in ("train", "val", "test")}
    seeds = [set(range(r.first_seed, r.first_seed + len(r))) for r in rooms.values()]
    assert len(set.union(*seeds)) == sum(map(len, seeds)) == 480


@pytest.mark.slow
@pytest.mark.parametrize("network", SPHERE_NETWORKS)
def test_training(run: Run, tmp_path: Path, network: str) -> None:
    run("train", *ROOMS, f"model.network={network}", f"data.cache_dir={tmp_path}/rooms", "output=run")
    (tested,) = json.loads((tmp_path / "run/test.json").read_text()).values()
    assert set(tested) == set(ORIENTATIONS)
    assert all(0 <= value <= 100 for value in tested.values())
