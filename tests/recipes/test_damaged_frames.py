# SPDX-License-Identifier: Apache-2.0
"""Frames of a data set that cannot be read: one paragraph, the same with worker processes, or skipped and counted."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
import torch
from torch._utils import ExceptionWrapper

from sphericalvision.cameras import ring_rig
from sphericalvision.core import FileFormatError
from sphericalvision.data import write_omnistereo
from sphericalvision.recipes.app.errors import _message
from sphericalvision.recipes.datamodules.omnistereo import SkipDamaged
from tests.recipes.tiny import TINY_TRAINING, Run
from tests.worlds import recorded_frames

SKIP = "data.on_error=skip"


@pytest.fixture
def frames(tmp_path: Path) -> Path:
    """Three frames, of which the second has an image that was cut off."""
    root = tmp_path / "set"
    rig = ring_rig(4, image_size=(32, 32))
    write_omnistereo(root, recorded_frames(rig, [1, 2, 3], height=32), rig)
    image = root / "cam2" / "00002.png"
    image.write_bytes(image.read_bytes()[:200])
    return root


def words(root: Path, *more: str) -> list[str]:
    splits = [f"data.{split}_split=all" for split in ("train", "val", "test")]
    return ["data=omnistereo", f"data.root={root}", *splits, "data.batch_size=1", *more]


def test_the_message_is_the_same_with_worker_processes(failing: Run, frames: Path, weights: Path) -> None:
    said = [
        failing("evaluate", f"checkpoint={weights}", *words(frames, f"data.num_workers={number}"))
        for number in (0, 1)
    ]
    assert said[0] == said[1]
    assert "cam2/00002.png: cannot be read as an image (200 bytes)" in said[0]


def test_a_full_disk_is_told_of_a_worker_process_too() -> None:
    try:
        raise OSError(28, "No space left on device")
    except OSError:
        wrapped = ExceptionWrapper(where="in DataLoader worker process 0")
    with pytest.raises(OSError, match="Original Traceback") as caught:
        wrapped.reraise()
    assert str(_message(caught.value)).startswith("No space left on device; ")


@pytest.mark.parametrize("link", ["__cause__", "__context__"])
def test_a_mistake_is_told_whatever_it_has_led_to(link: str) -> None:
    error = RuntimeError("what it has led to")
    setattr(error, link, FileFormatError("the mistake"))
    assert _message(error) == "the mistake"


def test_evaluation_goes_without_the_frame_and_says_so(
    run: Run, frames: Path, weights: Path, tmp_path: Path
) -> None:
    without, said = tmp_path / "without", []
    shutil.copytree(frames, without, ignore=shutil.ignore_patterns("00002*"))
    for root, more in ((frames, SKIP), (without, "data.on_error=stop")):
        given = words(root, more, "data.num_workers=1", f"output={root.name}-out", "baselines=false")
        said.append(run("evaluate", f"checkpoint={weights}", *given))
    tables = [json.loads((tmp_path / f"{name}-out/metrics.json").read_text()) for name in ("set", "without")]
    assert tables[0] == tables[1]
    assert said[0].count("1 of 3 frames were left out (data.on_error=skip). The first: ") == 1
    assert "cam2/00002.png: cannot be read" in said[0]
    assert "left out" not in said[1]


def test_training_takes_the_next_one_and_says_so(run: Run, frames: Path) -> None:
    tiny = [word for word in TINY_TRAINING if not word.startswith(("data.num_", "data.samples", "rig."))]
    said = run(
        "train", *tiny, *words(frames, SKIP, "data.num_workers=1"), "trainer.max_steps=4", "output=run"
    )
    assert "1 of 3 frames were left out" in said
    assert "val MAE" not in said or "nan" not in said


class Numbers(torch.utils.data.Dataset[dict[str, torch.Tensor]]):
    """Samples of which some cannot be read."""

    def __init__(self, damaged: set[int]) -> None:
        self.damaged = damaged

    def __len__(self) -> int:
        return 4

    def __getitem__(self, index: int) -> dict[str, torch.Tensor]:
        if index in self.damaged:
            raise FileFormatError(f"{index}.png: is damaged")
        return {"number": torch.tensor(index), "valid": torch.ones(2, dtype=torch.bool)}


def test_the_next_sample_stands_in_and_counts_in_training_alone() -> None:
    training, test = (SkipDamaged(Numbers({1, 2}), counts) for counts in (True, False))
    assert [int(training[index]["number"]) for index in range(4)] == [0, 3, 3, 3]
    assert [bool(training[index]["valid"].all()) for index in range(4)] == [True] * 4
    assert [bool(test[index]["valid"].any()) for index in range(4)] == [True, False, False, True]
    assert (
        training.left_out()
        == "2 of 4 frames were left out (data.on_error=skip). The first: 1.png: is damaged"
    )
    assert SkipDamaged(Numbers(set()), True).left_out() is None
    with pytest.raises(FileFormatError, match=r"none of 4 frames can be read. The first: 0.png: is damaged"):
        SkipDamaged(Numbers({0, 1, 2, 3}), True)[2]
