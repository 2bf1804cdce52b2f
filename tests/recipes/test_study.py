# SPDX-License-Identifier: Apache-2.0
"""The study: what counts, pictures, and nothing done twice."""

from __future__ import annotations

import contextlib
import errno
import html
import json
import math
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from hydra import compose, initialize_config_module
from omegaconf import DictConfig, OmegaConf

from sphericalvision.cameras import CameraRig, ring_rig
from sphericalvision.data import SampleView, write_omnistereo
from sphericalvision.icosphere import Icosphere
from sphericalvision.io.images import read_image
from sphericalvision.models import save_weights
from sphericalvision.recipes.app.cli import build, print_config
from sphericalvision.recipes.app.rigs import make_ring
from sphericalvision.recipes.commands import train as train_command
from sphericalvision.recipes.evaluation.loop import errors_of_frame
from sphericalvision.recipes.evaluation.methods import Answer, Method, Scale
from sphericalvision.recipes.evaluation.pictures import DrawnFrame, frames_sheet
from sphericalvision.recipes.evaluation.protocols import Protocols
from sphericalvision.recipes.evaluation.records import write_json
from sphericalvision.recipes.evaluation.tables import Table, save_report
from sphericalvision.recipes.study.models import median, study_models
from sphericalvision.recipes.study.tilted_views import View, view_frames
from sphericalvision.recipes.study.training import differences, training_config
from sphericalvision.recipes.training import stages
from tests.recipes.tiny import Run, composed, typed
from tests.worlds import recorded_frames

SCALE = Scale(num_hypotheses=8, min_depth=0.55)
RIGHT = 7 * 0.55 * 0.5
"""Index of the true depth of ``frame_at``."""


class Estimates(Answer):
    """Index ``(V,)`` of directions as a function says, known where it is not NaN."""

    def __init__(self, index: Callable[[torch.Tensor], torch.Tensor]) -> None:
        self.index = index

    def index_at(self, directions: torch.Tensor, scale: Scale) -> tuple[torch.Tensor, torch.Tensor]:
        index = self.index(directions)[None]
        return index, ~index.isnan()


def frame_at(tilt: float) -> dict[str, Any]:
    """A frame that is 2 m away everywhere."""
    vertices, panorama = Icosphere(2).vertices, (8, 32)
    return {
        "inverse_depth": torch.full((1, len(vertices)), 0.5),
        "valid": torch.ones(1, len(vertices), dtype=torch.bool),
        "panorama_inverse_depth": torch.full((1, *panorama), 0.5),
        "panorama_valid": torch.ones(1, *panorama, dtype=torch.bool),
        "rig": ring_rig(4, image_size=(32, 32)).rotated(tilt=tilt),
    }


def cameras_of(rig: CameraRig, directions: torch.Tensor) -> torch.Tensor:
    """Written out: how many of the cameras have the point within 110° of their axes."""
    points = 2.0 * directions[:, None] - rig.positions
    angles = torch.acos((points * rig.axes).sum(-1) / points.norm(dim=-1))
    return (angles < math.radians(110)).sum(-1)


def errors_of(frame: dict[str, Any], index: Callable[[torch.Tensor], torch.Tensor]) -> dict[str, Any]:
    protocols = Protocols(SCALE, 2)
    return errors_of_frame(protocols.errors(Estimates(index), protocols.truth(frame)), 0)


@pytest.mark.parametrize("tilt_deg", [0, 45])
def test_what_fewer_than_two_cameras_see_does_not_count(tilt_deg: int) -> None:
    """Off by 0.04 where two cameras see the point, by 3 elsewhere."""
    frame = frame_at(math.radians(tilt_deg))
    errors = errors_of(
        frame, lambda d: torch.where(cameras_of(frame["rig"], d) >= 2, RIGHT + 0.04, RIGHT + 3.0)
    )
    assert errors["paper"]["MAE"] == pytest.approx(100 * 0.04 / 8, rel=1e-3)
    assert errors["solid_angle"]["MAE"] == pytest.approx(0.5, rel=1e-3)
    assert errors["omnimvs"]["MAE"] == pytest.approx(100 * (0.04 * 191 / 7) / 192, rel=1e-3)
    share = errors["points"]["left_out"]
    if tilt_deg:
        assert 10 < share < 30
        expected = (1 - share / 100) * 0.5 + share / 100 * 100 * 3 / 8
        assert errors["all"]["MAE"] == pytest.approx(expected, rel=1e-3)
        assert errors["four"]["MAE"] == pytest.approx(0.5, rel=1e-3)
    else:
        assert share == 0


def test_zones_are_counted_apart() -> None:
    """Off by the sine of the latitude, doubled where three cameras see: means over vertices, written out."""
    frame = frame_at(0.3)

    def offset(directions: torch.Tensor) -> torch.Tensor:
        return directions[:, 1].abs() * torch.where(cameras_of(frame["rig"], directions) == 3, 2.0, 1.0)

    vertices = Icosphere(2).vertices
    up, cameras = -vertices[:, 1], cameras_of(frame["rig"], vertices)
    errors = errors_of(frame, lambda directions: RIGHT + offset(directions))
    zones = {"above": up > 0.5, "around": up.abs() <= 0.5, "below": up < -0.5, "two": cameras == 2}
    zones |= {"three": cameras == 3, "four": cameras == 4}
    for name, zone in zones.items():
        expected = 100 / 8 * offset(vertices)[zone & (cameras >= 2)].mean().item()
        assert errors[name]["MAE"] == pytest.approx(expected, rel=1e-3), name


def test_nothing_is_counted_where_a_model_says_nothing() -> None:
    errors = errors_of(frame_at(0.0), lambda d: torch.where(d[:, 1] > 0, RIGHT + 0.4, math.nan))
    assert errors["paper"]["MAE"] == pytest.approx(5.0, rel=1e-3)
    unknown = (Icosphere(2).vertices[:, 1] <= 0).float().mean().item()
    assert errors["points"]["unknown"] == pytest.approx(100 * unknown)


def test_pictures_show_and_fade() -> None:
    vertices = Icosphere(2).vertices
    truth = 4 + 2 * vertices[:, 1]
    view = np.full((40, 80, 3), 200, np.uint8)
    frame = DrawnFrame(view, view, truth, vertices[:, 1] >= 0, {"a": truth + 1}, Scale(8, 0.55))
    plain = frame._replace(counts=torch.ones_like(frame.counts))
    assert list(frame.pictures()) == ["first camera", "view", "truth", "a: MAE 12.50", "error of a"]
    for title in ("a: MAE 12.50", "error of a"):
        some, every = (np.ptp(each.pictures()[title], axis=-1) for each in (frame, plain))
        assert some[:20].mean() < 0.5 * every[:20].mean()
        assert some[20:].mean() > 0.9 * every[20:].mean()
    assert frames_sheet({"0°": frame, "45°": plain}).shape[-1] == 3


def test_pages_show_names_as_they_are(tmp_path: Path) -> None:
    """Names of methods and tracks are those of files, which strangers may have chosen."""
    name = "</script><script>alert(1)</script> & __TABLE__"
    table = Table(f"of {name}", ("method", name), [[name, 1.0]])
    save_report(tmp_path, "page", name, {"errors": table}, {name: 'pages/a &"b".png'}, [])
    page = (tmp_path / "index.html").read_text()
    assert "<script" not in page
    assert page.count(html.escape(name)) == 5
    assert 'src="pages/a%20%26%22b%22.png"' in page
    assert "| method |" in (tmp_path / "page.md").read_text()


@pytest.fixture(scope="session")
def words(tmp_path_factory: pytest.TempPathFactory) -> tuple[str, ...]:
    """Words of the smallest study; its scenes are rendered once for all tests."""
    cache = tmp_path_factory.mktemp("study_scenes")
    return typed(f"study=tiny data.num_workers=0 data.samples_per_pixel=1 data.cache_dir={cache} output=out")


class Trainer:
    """Stands for the training: writes untrained networks, and remembers for whom."""

    def __init__(self) -> None:
        self.trained: list[str] = []
        self.error: Exception | None = None

    def __call__(self, config: DictConfig, folder: Path) -> dict[str, float]:
        assert config.resume == "auto"
        assert Path(config.output) == folder.parent
        self.trained.append(f"{folder.parent.name}/{folder.name}")
        print_config(config, folder)
        if self.error is not None:
            raise self.error
        torch.manual_seed(config.seed)
        save_weights(build(config.model), folder / "checkpoints" / "best.safetensors")
        write_json(folder / "validation.json", {"best": {"MAE": 1.0}})
        return {"MAE": 1.0}


@pytest.fixture
def trainer(monkeypatch: pytest.MonkeyPatch) -> Trainer:
    stand_in = Trainer()
    monkeypatch.setattr(train_command, "train", stand_in)
    return stand_in


@pytest.fixture
def measured(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The methods that are asked, each once for every batch."""
    asked: list[str] = []
    answer = Method.__call__

    def counting(self: Method, batch: Any) -> Any:
        asked.append(self.name)
        return answer(self, batch)

    monkeypatch.setattr(Method, "__call__", counting)
    return asked


def test_a_study_writes_everything_and_does_nothing_twice(
    run: Run, tmp_path: Path, words: tuple[str, ...], trainer: Trainer, measured: list[str]
) -> None:
    out = tmp_path / "out"
    run("study", *words, "seeds=[0,1]", "inputs=equirect")
    assert trainer.trained == [f"{name}/seed{k}" for name in ("icosweepnet", "omnimvs") for k in (0, 1)]
    assert len(measured) == 3 * 6
    for name in ("table", "details", "change", "inputs"):
        for suffix in (".md", ".csv"):
            assert (out / f"{name}{suffix}").stat().st_size > 0
    for name in ("panels.png", "errors_against_angle.png"):
        assert read_image(out / name).std() > 0.05
    everything = json.loads((out / "study.json").read_text())
    assert len(everything["results"]) == 18
    assert [t["config"]["seed"] for t in everything["trainings"]] == [0, 1, 0, 1]
    assert "| OmniMVS |" in (out / "study.md").read_text()
    table = (out / "table.md").read_text()
    assert (out / "table.csv").read_text().startswith("θ,model,>1,>1 sd,>3,>3 sd,")
    assert (out / "inputs.csv").read_text().startswith("images,model,>1,")

    run("study", *words, "seeds=[0,1]", "inputs=equirect")
    assert (len(trainer.trained), len(measured)) == (4, 3 * 6)
    assert (out / "table.md").read_text() == table

    (out / "records/fisheye-45deg/semi_global.json").unlink()
    run("study", *words, "seeds=[0,1]", "inputs=equirect")
    assert measured[3 * 6 :] == ["semi_global"]
    few = ("models.omnimvs=null", "models.constant=null", "angles_deg=[0]")
    run("study", *words, "seeds=[0,1]", "num_hypotheses=8", *few)
    assert len(trainer.trained) == 4
    assert len(measured) == 3 * 6 + 1 + 3


ONLY = ("models.omnimvs=null", "models.semi_global=null", "models.constant=null", "angles_deg=[0]")


def test_other_words_for_a_training_are_refused_or_redone(
    run: Run, failing: Run, tmp_path: Path, words: tuple[str, ...], trainer: Trainer
) -> None:
    run("study", *words, *ONLY)
    changed = (*words, *ONLY, "extra_training=['optimizer.lr=0.5']")
    message = failing("study", *changed)
    assert "icosweepnet, seed 0: trained in" in message
    assert "optimizer.lr was 0.001, is 0.5" in message
    assert "on_change=redo" in message
    assert len(trainer.trained) == 1
    run("study", *words, *ONLY, "extra_training=['trainer.log_every_n_steps=5','data.num_workers=0']")
    assert len(trainer.trained) == 1
    run("study", *changed, "on_change=redo")
    run("study", *changed)
    assert len(trainer.trained) == 2


def test_a_training_that_dies_is_told_and_taken_up_again(
    run: Run, failing: Run, tmp_path: Path, words: tuple[str, ...], trainer: Trainer
) -> None:
    trainer.error = OSError(errno.ENOSPC, "no space left")
    message = failing("study", *words, *ONLY)
    assert "Error: no space left; free the disk" in message
    assert "models/icosweepnet 'hydra.sweep.subdir=seed${seed}' resume=auto" in message
    assert "nothing is trained yet" in failing("study", *words, *ONLY, "train=false")
    trainer.error = None
    run("study", *words, *ONLY)
    assert trainer.trained == ["icosweepnet/seed0"] * 2


@pytest.mark.parametrize("status", [0, 1, 143])
def test_the_status_of_a_training_in_several_processes_is_passed_on(
    monkeypatch: pytest.MonkeyPatch, status: int
) -> None:
    commands: list[list[str]] = []
    process = SimpleNamespace(wait=lambda: status)
    monkeypatch.setattr(stages.subprocess, "Popen", lambda words: commands.append(words) or process)
    with pytest.raises(SystemExit, match=f"^{status}$") if status else contextlib.nullcontext():
        stages.run_training(["seed=1"], OmegaConf.create({"trainer": {"devices": 2}}))
    assert commands == [[sys.executable, "-m", "sphericalvision.recipes.train", "seed=1"]]


def test_weights_that_are_there_are_taken_by_seed(
    run: Run, tmp_path: Path, words: tuple[str, ...], weights: Path
) -> None:
    weights.rename(tmp_path / "ico-7.safetensors")
    run("study", *words, *ONLY, "models.icosweepnet.checkpoint=ico-{seed}.safetensors", "seeds=[7]")
    (only,) = json.loads((tmp_path / "out/study.json").read_text())["results"]
    assert (only["seed"], only["label"]) == (7, "IcoSweepNet")
    run("study", *words, *ONLY, "models.icosweepnet=null", "checkpoint=ico-7.safetensors")
    (own,) = json.loads((tmp_path / "out/study.json").read_text())["results"]
    assert (own["method"], own["label"], own["errors"]) == ("own", "ico-7", only["errors"])


def test_images_on_disk_are_turned(
    run: Run, tmp_path: Path, words: tuple[str, ...], trainer: Trainer
) -> None:
    rig = make_ring(image_size=(48, 48))
    write_omnistereo(tmp_path / "house", recorded_frames(rig, [1, 2], height=32), rig)
    disk = ("study=tiny", "data=omnihouse", f"data.root={tmp_path / 'house'}", "data.test_split=all")
    run("study", *disk, "data.num_workers=0", "output=out")
    results = json.loads((tmp_path / "out/study.json").read_text())["results"]
    left_out = {r["frames"]: r["errors"]["points"]["left_out"] for r in results}
    assert left_out["fisheye-0deg"] < 1
    assert 10 < left_out["fisheye-45deg"] < 40
    config = composed("study", *disk[:2], f"data.root='{tmp_path / 'house'}'", disk[3])
    ((_, batch),) = view_frames(config, View("fisheye", 45.0)).batches(["0"])
    assert batch["fisheye"].shape == (1, 4, 3, 32, 32)
    assert (batch["fisheye"][..., 0, 0] == 0).all()
    torch.testing.assert_close(batch["rig"].select(0).axes[0], torch.tensor([0.0, 0.5**0.5, 0.5**0.5]))


def test_the_constant_map_is_of_as_many_frames_as_the_study_says(words: tuple[str, ...]) -> None:
    with initialize_config_module("sphericalvision.conf", version_base="1.3"):
        config = compose("study", [*words, "baseline_frames=1"])
        (model,) = (model for model in study_models(config) if model.kind == "constant")
        training = training_config(model.words(config))
        index = median(config, training).predict(torch.zeros(1, 2, 3, 642), None).index[0]
    data = build(training.data)
    data.min_depth = config.model.min_depth
    data.view = SampleView(depth_level=1)
    (first, *_) = data.plain_train_dataset()
    expected = (config.num_hypotheses - 1) * config.model.min_depth * first["inverse_depth"]
    torch.testing.assert_close(index, expected)


def test_random_tilts_are_all_that_their_trainings_change() -> None:
    with initialize_config_module("sphericalvision.conf", version_base="1.3"):
        config = compose("study", ["study=random_tilts"])
        models = study_models(config)
        trainings = {m.name: t.config for m in models for t in m.trainings(config, Path())[:1]}
    assert list(trainings) == ["icosweepnet", "omnimvs", "icosweepnet_random", "omnimvs_random"]
    for name in ("icosweepnet", "omnimvs"):
        level, tilted = trainings[name], trainings[f"{name}_random"]
        assert tilted.data.tilts_deg == [-15, 45]
        tilted.data.tilts_deg = None
        assert level == tilted


@pytest.mark.parametrize("preset", ["small", "paper", "tiny"])
def test_trainings_of_a_preset_differ_in_the_model_alone(preset: str) -> None:
    own = ("omnithings=/data/omnithings", "data.root=/data/omnihouse") if preset == "paper" else ()
    with initialize_config_module("sphericalvision.conf", version_base="1.3"):
        config = compose("study", [f"study={preset}", *own])
        own_trainings = [t for m in study_models(config) for t in m.trainings(config, Path())[:1]]
        trainings = [training.config for training in own_trainings]
        assert len(trainings) == 2
        for key in ("trainer", "optimizer", "scheduler", "loss", "data"):
            assert trainings[0][key] == trainings[1][key]
        for training in trainings:
            assert training.model.min_depth == config.model.min_depth
            assert training.model.get("level", config.model.level) == config.model.level
        models = [build(training.model) for training in trainings]
    assert not differences(own_trainings)
    trainings[0].data.seed, trainings[0].trainer.max_steps = 7, 7
    assert [note.split()[0] for note in differences(own_trainings)] == ["data.seed", "trainer.max_steps"]
    assert [type(net).__name__ for net in models] == ["IcoSweepNet", "OmniMVS"]
