# SPDX-License-Identifier: Apache-2.0
"""A key is looked at by its command, or refused by it: no key is taken and forgotten."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from dataclasses import is_dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
import torch
from hydra.utils import get_class
from omegaconf import OmegaConf

from sphericalvision.cameras import save_camera
from sphericalvision.recipes.app.checks import marks_of, unused_key
from sphericalvision.recipes.app.cli import build
from sphericalvision.recipes.app.command import Command
from sphericalvision.recipes.app.kinds import OnlyWith
from sphericalvision.recipes.app.rigs import make_ring
from sphericalvision.recipes.app.words import quote_paths
from sphericalvision.recipes.commands import export
from tests.recipes.board_pictures import COLUMNS, ROWS, SQUARE, write_boards
from tests.recipes.tiny import TINY_SCENES, TINY_TRAINING, Run, composed, write_capture

RIG = "calibration=c/rig.yaml"
IMAGES = "images=c/{camera}/{frame:05d}.png"
PREDICT = "predict checkpoint=weights.safetensors height=16 output=out device=cpu align=false"
CHECKPOINT = "checkpoint=weights.safetensors"
SCENES, TRAINING = " ".join(TINY_SCENES), " ".join(TINY_TRAINING)
RUNS = (
    f"{PREDICT} {RIG} {IMAGES}",
    f"{PREDICT} calibration=c/lens.yaml images=c/cam1 poses=c/poses.txt method=semi_global level=3",
    f"inspect {RIG} level=3 output=out",
    f"inspect {RIG} {IMAGES} level=3 output=out",
    f"convert {RIG}",
    f"convert {RIG} to=kannala_brandt output=new.yaml",
    "render rig=ring rig.image_size=[16,16] num_frames=1 height=16 samples_per_pixel=1",
    f"evaluate {CHECKPOINT} {SCENES} data.cache_dir=null output=out device=cpu",
    f"train {TRAINING} data.cache_dir=null callbacks=none trainer.max_steps=1 logger=none output=out",
    f"demo rig.image_size=[32,32] {CHECKPOINT} height=16 baseline_scenes=2 samples_per_pixel=1 device=cpu output=out",
    f"align {RIG} {IMAGES} stop=1 cameras=[cam1,cam2]",
    f"calibrate images=board/*.png board={COLUMNS}x{ROWS} square={SQUARE}",
    f"export {RIG} {CHECKPOINT} min_depth=0.5 height=16 formats=[] output=out",
)
"""Runs as small as they get; some find nothing to write, and end."""

NAMED = ("hydra", "output", "rig", "paths", "tags")
"""Keys that other values name: the folder of the run, the rig of the data, words in the records of a run."""


@pytest.fixture
def capture(tmp_path: Path, weights: Path) -> None:
    """A rig, two frames of its cameras, and poses for those of one."""
    rig = make_ring(4, radius=0.2, image_size=(24, 32))
    save_camera(rig.cameras["cam1"], tmp_path / "c/lens.yaml")
    generator = torch.Generator().manual_seed(1)
    frames = ({name: torch.rand(3, 24, 32, generator=generator) for name in rig.names} for _ in range(4))
    write_capture(tmp_path / "c", rig, *frames, file="{camera}/{frame:05d}.png")
    poses = (f"{frame} 0 {0.1 * frame} 0 0 0 0 1" for frame in range(4))
    (tmp_path / "c/poses.txt").write_text("\n".join(poses))


def keys_of(name: str) -> Any:
    """The types of a command's keys."""
    return import_module(f"sphericalvision.recipes.{name}").main.keys


@pytest.fixture
def looked_at(monkeypatch: pytest.MonkeyPatch) -> set[str]:
    """Keys of the configuration that a command looks at while it works."""
    found: set[str] = set()
    call = Command.call

    def watched(patch: pytest.MonkeyPatch, config: Any) -> None:
        kind = type(config)
        for name in ("__getattribute__",) if is_dataclass(kind) else ("__getattr__", "__getitem__", "get"):
            read = getattr(kind, name)

            def seen(self: Any, key: Any, *more: Any, read: Callable[..., Any] = read) -> Any:
                if self is config:
                    found.add(str(key).removesuffix("_"))
                return read(self, key, *more)

            patch.setattr(kind, name, seen)

    def calling(self: Command, config: Any, folder: Path) -> Any:
        nested = [value for value in vars(config).values() if is_dataclass(value)]
        with pytest.MonkeyPatch.context() as patch:
            for one in (config, *nested):
                watched(patch, one)
            return call(self, config, folder)

    monkeypatch.setattr(Command, "call", calling)
    return found


@pytest.mark.usefixtures("capture")
@pytest.mark.parametrize("words", RUNS, ids=lambda words: " ".join(words.split()[:3]))
def test_every_key_is_looked_at_or_refused(words: str, run: Run, tmp_path: Path, looked_at: set[str]) -> None:
    name, *overrides = words.split()
    if name == "calibrate":
        write_boards(tmp_path / "board")
    with contextlib.suppress(SystemExit):
        run(name, *overrides)
    assert looked_at
    config = composed(name, *quote_paths(overrides))
    keys = [str(key) for key in config if key not in NAMED]
    forgotten = [key for key in keys if key not in looked_at and not unused_key(keys_of(name), config, [key])]
    assert forgotten == []


@pytest.mark.usefixtures("capture")
def test_an_export_names_its_tables_and_its_programs(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(export, "programs", lambda *_: [Path("depth.onnx")])
    words = f"{RIG} {CHECKPOINT} min_depth=0.5 height=16 formats=[onnx] tables=inputs output=out"
    tables, program = run("export", *words.split()).splitlines()[-2:]
    assert (Path(tables).name, program) == ("tables.safetensors", "depth.onnx")


MARKED = ("predict", "inspect", "convert", "render", "calibrate", "train", "evaluate", "study")
"""Commands that have keys which count only with others."""


@pytest.mark.parametrize(
    ("name", "key", "mark"),
    [(name, *marked) for name in MARKED for marked in marks_of(keys_of(name)).items()],
)
def test_keys_that_do_not_count_are_refused(name: str, key: str, mark: OnlyWith) -> None:
    words: dict[str, tuple[str, ...]] = {
        "predict": ("min_depth=1", "outputs=[npz]"),
        "calibrate": ("to=pinhole",),
    }
    words |= dict.fromkeys(("train", "evaluate", "study"), ("data=omnihouse",))
    config = composed(name, *words.get(name, ()))
    message = unused_key(keys_of(name), config, [key])
    assert message is not None
    assert message.startswith(f"{key}: counts only with {(mark.remedy or mark.needed).partition('|')[0]}")
    other, _, values = mark.needed.partition("=")
    value: Any = values.partition("|")[0] or "given"
    OmegaConf.update(config, other, [value] if other == "outputs" else value, force_add=True)
    assert unused_key(keys_of(name), config, [key]) is None


NETWORK = ("model=icosweepnet_small", "model.level=3", "model.num_hypotheses=4", "model.feature_channels=2")
ONE = ("data.num_train=1", "data.num_val=1", "data.num_test=1")
SMALL = (*NETWORK, *ONE, "data.samples_per_pixel=1", "data.num_workers=0")
DATA = (
    (*SMALL, "data=scenes", "rig.image_size=[16,16]", "data.carrier=pole"),
    (*SMALL, "data=random_rigs", "data.image_size=[16,16]"),
    ("experiment=spherical_digits", "model.level=3"),
    ("experiment=segmentation", "model.level=3", *ONE),
)
"""Words of trainings whose data can be made at once."""


@pytest.mark.parametrize("words", DATA, ids=lambda words: " ".join(words[-2:]))
def test_every_key_of_data_is_looked_at_or_refused(
    words: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = composed("train", *words)
    if "cache_dir" in config.data:
        config.data.cache_dir = str(tmp_path)
    kind, found = get_class(config.data._target_), set()
    read = kind.__getattribute__

    def seen(self: Any, name: str) -> Any:
        found.add(name)
        return read(self, name)

    monkeypatch.setattr(kind, "__getattribute__", seen)
    data = build(config.data)
    data.bind_network(build(config.model))
    data.prepare_data()
    for split in ("train", "val", "test"):
        _ = data.dataset(split)[0]
    data.train_dataloader()
    keys = [str(key) for key in config.data if key != "_target_"]
    forgotten = [
        key for key in keys if key not in found and not unused_key(keys_of("train"), config, [f"data.{key}"])
    ]
    assert forgotten == []
