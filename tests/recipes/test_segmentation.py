# SPDX-License-Identifier: Apache-2.0
"""Segmentation of rooms: networks that are alike, rotations that are right, scores by hand, and a training."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest
import torch

from sphericalvision.data.augmentation.sphere_rotation import yaw_on_sphere
from sphericalvision.icosphere import Icosphere
from sphericalvision.models import SphereSegmenter
from sphericalvision.models.sphere_blocks import SPHERE_NETWORKS
from sphericalvision.recipes.segmentation.rooms import (
    ORIENTATIONS,
    LabelledRooms,
    LabelledRoomsDataModule,
    orientation_rotation,
)
from sphericalvision.scenes import make_scene, ray_labels
from tests.recipes.tiny import Run, typed

TINY = (
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
    """Something in direction d of the room is at R d of the sample."""
    grid = Icosphere(3)
    sample = LabelledRooms(7, 1, grid, orientation)[0]
    turn = orientation_rotation(orientation, 7)
    torch.testing.assert_close(turn @ turn.mT, torch.eye(3), atol=1e-5, rtol=0)
    inverse = torch.linalg.inv(turn)
    seen = torch.stack([inverse @ direction for direction in grid.directions.float()])
    expected = ray_labels(make_scene("room", 7), torch.zeros(3), seen)
    assert (sample["label"] == expected).float().mean() > 0.99
    assert sample["values"].abs().max() <= 1
    down = math.degrees(math.acos(float((turn @ torch.tensor([0.0, 1.0, 0.0]))[1].clamp(-1, 1))))
    tilt = ORIENTATIONS[orientation]
    assert tilt is None or down == pytest.approx(tilt, abs=0.05)


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
    run("train", *TINY, f"model.network={network}", f"data.cache_dir={tmp_path}/rooms", "output=run")
    (tested,) = json.loads((tmp_path / "run/test.json").read_text()).values()
    assert set(tested) == set(ORIENTATIONS)
    assert all(0 <= value <= 100 for value in tested.values())
