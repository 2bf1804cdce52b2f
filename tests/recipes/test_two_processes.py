# SPDX-License-Identifier: Apache-2.0
"""Two processes are one: the same samples in the same order, each validation sample once, nearly the same weights."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from sphericalvision.core import ArgumentError
from sphericalvision.recipes.datamodules.data_module import (
    SampleDataModule,
    TrainingBatches,
    TrainingStream,
    even_batches,
)
from sphericalvision.recipes.training.loaders import Loaders
from tests.processes import python
from tests.recipes.test_batches import Numbers
from tests.recipes.test_train import stored
from tests.recipes.tiny import Run

Words = tuple[str, ...]
DDP = ("trainer.devices=2", "trainer.strategy=ddp", "data.batch_size=1")


def test_a_training_stream_is_a_function_of_seed_and_position() -> None:
    """Every round holds each sample once; a stream that starts later is the same stream, noise included."""
    stream = TrainingStream(Numbers(5), seed=3)
    whole = [stream[i] for i in range(15)]
    for start in (0, 5, 10):
        assert sorted(sample["index"] for sample in whole[start : start + 5]) == [0, 1, 2, 3, 4]
    assert [sample["index"] for sample in whole[:5]] != [sample["index"] for sample in whole[5:10]]
    later = TrainingBatches(stream, batch_size=1, length=8, start=7)
    assert [stream[i] for (i,) in later] == whole[7:]
    assert [sample["index"] for sample in whole[:10]] == [4, 2, 1, 3, 0, 1, 3, 0, 4, 2]
    assert torch.stack([sample["noise"] for sample in whole[:3]]).tolist() == pytest.approx(
        [0.0571, 0.4651, 0.7912], abs=1e-4
    )
    other = TrainingStream(Numbers(5), seed=4)
    assert [other[i]["noise"] for i in range(5)] != [sample["noise"] for sample in whole[:5]]


def test_batches_seen_are_those_of_all_processes() -> None:
    loaders = Loaders(SampleDataModule())
    loaders.trainer = SimpleNamespace(global_step=5, accumulate_grad_batches=2, world_size=4)  # type: ignore[assignment]
    assert loaders.state_dict() == {"batches_seen": 5 * 2 * 4}


@given(st.integers(1, 40), st.integers(1, 6), st.integers(1, 8))
def test_each_sample_is_validated_once_and_nobody_waits(number: int, batch_size: int, world: int) -> None:
    if number < world:
        with pytest.raises(ArgumentError, match="too few"):
            even_batches(number, batch_size, world)
        return
    batches = even_batches(number, batch_size, world)
    assert [index for batch in batches for index in batch] == list(range(number))
    assert len(batches) % world == 0
    assert all(batches)
    if number % (batch_size * world) == 0:
        assert {len(batch) for batch in batches} == {batch_size}


def train(folder: Path, *words: str) -> str:
    """Train in a process of its own, which starts the other; gives what was printed. Lightning has no advice."""
    return python(
        "-W", "error:It is recommended to use", "-m", "sphericalvision.recipes.train", *words, folder=folder
    )


def errors(folder: Path) -> dict[str, float]:
    (values,) = json.loads((folder / "validation.json").read_text()).values()
    return values


@pytest.mark.slow
def test_two_processes_train_as_one(run: Run, tmp_path: Path, tiny_training: Words) -> None:
    """The loss is the mean over the known points of a process, so weights differ by as much as their shares do."""
    short = ("data.num_val=3", "logger=none", "callbacks.panels=null", "optimizer=sgd")
    words = (*tiny_training, *short)  # Adam's first steps have one length, however small a gradient is
    run("train", *words, "trainer.max_steps=3", "data.batch_size=2", "output=one")
    printed = train(tmp_path, *words, *DDP, "trainer.max_steps=3", "output=two")
    assert printed.count("Results are in") == 1
    train(tmp_path, *words, *DDP, "trainer.max_steps=1", "output=parts")
    train(tmp_path, *words, *DDP, "trainer.max_steps=3", "output=parts", "resume=auto")
    one, two, parts = (stored(tmp_path / name)["state_dict"] for name in ("one", "two", "parts"))
    torch.testing.assert_close(two, one, rtol=1e-3, atol=1e-3)
    torch.testing.assert_close(parts, two, rtol=0, atol=0)
    assert errors(tmp_path / "two") == pytest.approx(errors(tmp_path / "one"), rel=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize(("number", "status"), [(signal.SIGTERM, 143), (signal.SIGINT, 130)])
@pytest.mark.parametrize("all_of_them", [True, False])
def test_two_processes_stop_together_and_go_on(
    tmp_path: Path, tiny_training: Words, number: signal.Signals, status: int, all_of_them: bool
) -> None:
    """A job queue signals all processes, and ``kill`` one of them."""
    words = (*tiny_training, *DDP, "data.num_val=2", "logger=none", "callbacks.panels=null", "output=run")
    long = (
        "trainer.max_steps=100000",
        "trainer.val_check_interval=100000",
        "callbacks.progress.every_seconds=0.001",
    )
    command = [sys.executable, "-m", "sphericalvision.recipes.train", *words, *long]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    with subprocess.Popen(
        command,
        cwd=tmp_path,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
    ) as process:
        assert process.stdout is not None
        printed, watchdog = "", threading.Timer(200, os.killpg, (process.pid, signal.SIGKILL))
        watchdog.start()
        for line in process.stdout:
            printed += line
            if "step 5 of" in line:
                (os.killpg if all_of_them else os.kill)(process.pid, number)
        watchdog.cancel()
        assert process.wait() == status, printed
    assert "Stopped at step" in printed
    stopped = stored(tmp_path / "run")["global_step"]
    assert stopped >= 5
    end = f"trainer.max_steps={stopped + 1}"
    train(tmp_path, *words, end, f"trainer.val_check_interval={stopped + 1}", "resume=auto")
    assert stored(tmp_path / "run")["global_step"] == stopped + 1
