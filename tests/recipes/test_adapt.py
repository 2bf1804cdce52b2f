# SPDX-License-Identifier: Apache-2.0
"""A network is adapted to a capture without truth, and stays as it was where that does not help."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from omegaconf import OmegaConf

from sphericalvision.cameras import ring_rig, save_rig
from sphericalvision.capture.preparation.preparation import AS_IT_IS
from sphericalvision.capture.pseudo_labels import PseudoLabels
from sphericalvision.core import ArgumentError
from sphericalvision.data import SampleView
from sphericalvision.io.images import write_image
from sphericalvision.models import IcoSweepNet, RefinedSweepNet, load_weights
from sphericalvision.recipes.datamodules.capture import (
    CaptureDataModule,
    CaptureSamples,
    LabelledFrame,
    _with_rows,
    rehearsed_world,
)
from sphericalvision.recipes.training.adapt_module import AdaptModule
from sphericalvision.scenes import WorldSamples
from sphericalvision.scenes.cache import encode
from sphericalvision.scenes.disturbances import CameraDisturbance
from tests.recipes.test_align import KNOCKED, write_knocked_capture
from tests.recipes.tiny import Run, composed, typed
from tests.values import rand

TINY = (
    *typed(
        "model=icosweepnet_small model.level=3 model.num_hypotheses=4 model.feature_channels=2 output=run"
    ),
    *typed("trainer.max_steps=2 trainer.val_check_interval=1 trainer.accelerator=cpu callbacks.panels=null"),
)
REHEARSAL = OmegaConf.to_container(composed("train", "experiment=adapt", "capture=c").data.world)
CALIBRATED = "data.calibration=c/rig.yaml"


def same(one: Path, other: Path) -> bool:
    states = [load_weights(path).state_dict() for path in (one, other)]
    return all(torch.equal(states[0][name], states[1][name]) for name in states[1])


def test_the_prior_learns_along_and_without_hints() -> None:
    net = RefinedSweepNet.around(IcoSweepNet(5, aggregation="variance", feature_channels=2))
    module = AdaptModule(net, loss=None, optimizer=None, scheduler=None)
    assert all(parameter.requires_grad for parameter in net.prior.parameters())
    assert module.hints == 0


@pytest.mark.slow
@pytest.mark.parametrize("rises", [True, False])
def test_weights_are_kept_only_if_photo_consistency_rises(
    rises: bool, run: Run, weights: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_knocked_capture(tmp_path / "c", degrees=0.0)
    monkeypatch.setattr(CaptureDataModule, "start_share", -1.0 if rises else 2.0)
    words = ("capture=c/{camera}/{frame:05d}.png", f"init_weights={weights}", *TINY)
    printed = run("train", "experiment=adapt", *words, CALIBRATED)
    result = tmp_path / "run" / "adapted.safetensors"
    assert f"checkpoint={result}" in printed
    assert ("the old weights stay" in printed) == (not rises)
    assert same(result, weights) == (not rises)
    assert load_weights(result).min_depth == load_weights(weights).min_depth


@pytest.mark.slow
def test_frames_are_divided_and_taught_by_the_network_itself(tmp_path: Path, weights: Path) -> None:
    write_knocked_capture(tmp_path / "c", degrees=0.0)
    data = CaptureDataModule(
        images=f"{tmp_path}/c",
        world=REHEARSAL,
        calibration=f"{tmp_path}/c/rig.yaml",
        held_out_every=2,
        min_depth=1.1,
        rendered=0.0,
    )
    net = load_weights(weights)
    data.bind_network(net)
    data.setup("fit")
    assert data.names == ["00000", "00001", "00002", "00003"]
    assert data.held_out == ["00001", "00003"]
    assert 0 < data.start_share < 1
    judged, learned = data.dataset("val"), data.dataset("train")
    assert len(judged) == len(learned) == 2
    sample, disturbed = judged[0], learned[0]
    # at half the size the nearest hypothesis is the network's
    torch.testing.assert_close(sample["rig"].positions, KNOCKED.positions / 2)
    with torch.no_grad():
        said = net.eval().predict(sample["images"][None], sample["rig"], sample["seen"][None])
    index = sample["inverse_depth"] * net.min_depth * (net.num_hypotheses - 1)
    sure = said.confidence[0] >= 0.5
    assert (sample["valid"] >= sure).all()
    torch.testing.assert_close(index[sure], said.index[0][sure], atol=1e-4, rtol=0)
    assert disturbed["frame"] == "00000"
    assert disturbed["images"].shape == sample["images"].shape
    assert "correlation" not in disturbed


@pytest.mark.slow
def test_rendered_scenes_stand_in_a_share_of_the_time(tmp_path: Path, weights: Path) -> None:
    write_knocked_capture(tmp_path / "c", degrees=0.0)
    words = {"calibration": f"{tmp_path}/c/rig.yaml", "min_depth": 1.1, "rendered": 1.0}
    data = CaptureDataModule(images=f"{tmp_path}/c", world=REHEARSAL, **words)  # type: ignore[arg-type]
    data.bind_network(load_weights(weights))
    data.setup("fit")
    torch.manual_seed(0)
    sample = data.dataset("train")[0]
    kind, _, seed = sample["frame"].rpartition("-")
    assert kind
    assert int(seed) >= 5_000_000
    assert sample["images"].shape == (3, 3, 642)
    turns = sample["rig"].positions - KNOCKED.positions / 2
    assert float(turns.abs().max()) < 1e-6  # cameras turn by a little where they stand


def test_a_rehearsed_scene_and_its_disturbances_are_those_of_its_seed() -> None:
    world = rehearsed_world(KNOCKED.resized((16, 16)), 1.0, AS_IT_IS, REHEARSAL)
    scenes = WorldSamples(world, SampleView(3, 2, antialias=True), range(5_000_000, 5_000_002))
    one, plain = (
        scenes[1],
        WorldSamples(replace(world, faults=CameraDisturbance()), scenes.view, scenes.seeds)[1],
    )
    assert torch.equal(one["images"], scenes[1]["images"])
    assert torch.equal(one["inverse_depth"], plain["inverse_depth"])
    assert not torch.equal(one["images"], plain["images"])
    torch.testing.assert_close(one["images"][:, 0], one["images"][:, 2], atol=0.3, rtol=0)


def test_pixels_of_frames_are_averaged() -> None:
    rig = ring_rig(2, image_size=(96, 96))
    noise = {name: encode((rand(3, 96, 96, seed=k) > 0.5).float()) for k, name in enumerate(rig.names)}
    sample = CaptureSamples([LabelledFrame("0", noise, PseudoLabels(*torch.zeros(5, 42)))], rig, 2)[0]
    assert sample["images"][sample["seen"][:, None].expand_as(sample["images"])].std() < 0.2


def test_a_scene_in_place_of_a_frame_has_the_scale_of_the_capture() -> None:
    sample = {"rig": ring_rig(2, 0.3), "inverse_depth": torch.tensor([0.5, 2.0]), "frame": "room-1"}
    scaled = CaptureSamples._scene([sample], 2.5)  # type: ignore[arg-type]
    torch.testing.assert_close(scaled["rig"].positions, 2.5 * sample["rig"].positions)
    assert scaled["inverse_depth"].tolist() == pytest.approx([0.2, 0.8])
    rig = ring_rig(2, image_size=(40, 62))
    sizes = [camera.image_size for rows in (20, 50) for camera in _with_rows(rig, rows).cameras.values()]
    assert sizes == [(20, 31)] * 2 + [(40, 62)] * 2


@pytest.mark.parametrize(("number", "every", "judged"), [(12, 5, [2, 7]), (2, 5, [1]), (6, 2, [1, 3, 5])])
def test_every_so_many_frames_judge(number: int, every: int, judged: list[int]) -> None:
    data = CaptureDataModule.__new__(CaptureDataModule)
    data.names, data.held_out_every = [str(k) for k in range(number)], every
    assert data.held_out == [str(k) for k in judged]


@pytest.mark.parametrize(("capture", "expected"), [(0.0, 0.2), (1.0, 1.0)])
def test_frames_of_a_grey_capture_stay_grey(capture: float, expected: float) -> None:
    """Of one with colours a share has none, as the world says."""
    data, net = CaptureDataModule.__new__(CaptureDataModule), SimpleNamespace(level=3, min_depth=0.55)
    data.names, data.held_out_every, data.labelled, data.rendered = [], 2, {}, 0.0
    vars(data).update(net=net, grey=capture, world=REHEARSAL, rig=KNOCKED, preparation=AS_IT_IS)
    assert data.dataset("train").disturbed.faults.grey == expected  # type: ignore[attr-defined]


def test_frames_are_of_the_whole_capture(tmp_path: Path) -> None:
    save_rig(KNOCKED.resized((16, 16)), tmp_path / "rig.yaml")
    for frame in range(6):
        for name in KNOCKED.names:
            write_image(tmp_path / name / f"{frame}.png", torch.rand(3, 16, 16))
    data = CaptureDataModule(
        images=f"{tmp_path}/{{camera}}/{{frame}}.png",
        calibration=f"{tmp_path}/rig.yaml",
        world=REHEARSAL,
        start=1,
        num_frames=3,
    )
    assert data.names == ["1", "3", "5"]


def test_scenes_of_the_benchmark_are_not_rehearsed() -> None:
    with pytest.raises(ArgumentError, match=r"data\.rendered_seed: .* 9900000 or less"):
        CaptureDataModule(images="nowhere", world=REHEARSAL, rendered_seed=9_900_001)


@pytest.mark.slow
def test_what_a_capture_must_have_is_told(failing: Run, tmp_path: Path) -> None:
    write_knocked_capture(tmp_path / "c", degrees=0.0)
    adapt = ("experiment=adapt", "output=run")
    assert "capture" in failing("train", *adapt)
    assert "nowhere" in failing("train", *adapt, "capture=nowhere")
    pattern = "capture=c/{camera}/{frame:05d}.png"
    assert "two or more frames" in failing("train", *adapt, pattern, CALIBRATED, "data.frames=[0]")
    assert "two or more that see" in failing("train", *adapt, pattern, CALIBRATED, "data.cameras=[cam1]")
    assert "data.held_out_every: expected" in failing("train", *adapt, pattern, "data.held_out_every=1")
    write_image(tmp_path / "d" / "cam1" / "0.png", torch.zeros(3, 8, 8))
    assert "calibration" in failing("train", *adapt, "capture=d")
