# SPDX-License-Identifier: Apache-2.0
"""Wrong words on the command line: each is one paragraph and status 1, never a traceback. A new one is one line."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from sphericalvision.cameras import ring_rig, save_rig

RIG = "calibration=capture/config.yaml"

FAULTS = (
    ("train", "modle=icosweepnet", "modle: there is no such key"),
    ("train", "model=icosweepnett", "known are icosweepnet"),
    ("train", "optimizer.learning_rate=1", "optimizer.learning_rate: there is no such key"),
    ("train", "experiment=quickstart trainer.max_step=3", "did you mean trainer.max_steps"),
    ("train", "data=omnithings", "data.root=..."),
    ("train", "seed=", "seed: expected a whole number"),
    ("train", "seed", "seed"),
    ("train", "tags=mine", "tags: expected a list"),
    ("train", "logger=mlfow", "known are"),
    ("train", "debug=overfitt", "known are"),
    ("predict", "", "calibration=..."),
    ("predict", RIG, "images=..."),
    ("predict", "rig=ring", "the file is calibration=ring"),
    ("evaluate", "chekpoint=x", "did you mean checkpoint"),
    ("render", "num_frame=3", "did you mean num_frames"),
    ("train", "seed=1.5", "seed: expected a whole number"),
    ("train", "seed=true", "seed: expected a whole number"),
    ("train", "seed=[1]", "seed: expected a whole number"),
    ("train", "data.batch_size=0", "data.batch_size: expected a whole number of 1 or more"),
    ("train", "data.batch_size=two", "data.batch_size: expected a whole number"),
    ("train", "trainer.max_steps=-2", "trainer.max_steps: expected a whole number of -1 or more"),
    ("train", "trainer.devices=0.5", "trainer.devices: expected"),
    ("train", "trainer.num_nodes=0", "trainer.num_nodes: expected"),
    ("train", "trainer.accumulate_grad_batches=0", "trainer.accumulate_grad_batches: expected"),
    ("train", "trainer.gradient_clip_val=-1", "trainer.gradient_clip_val: expected"),
    ("train", "trainer.use_distributed_sampler=true", "trainer.use_distributed_sampler: expected"),
    ("render", "num_frames=many", "num_frames: expected a whole number"),
    ("render", "samples_per_pixel=0", "samples_per_pixel: expected a whole number of 1 or more"),
    ("render", "height=-3", "height: expected a whole number of 1 or more"),
    ("render", "scale=0", "scale: expected a number above 0"),
    ("render", "first_seed=-1", "first_seed: expected a whole number of 0 or more"),
    ("predict", f"{RIG} images=x level=two", "level: expected"),
    ("predict", f"{RIG} images=x num_hypotheses=1", "num_hypotheses: expected a whole number of 2 or more"),
    ("predict", f"{RIG} images=x skip_existing=maybe", "skip_existing: expected true or false"),
    ("inspect", f"{RIG} level=-1", "level: expected a whole number of 0 or more"),
    ("inspect", f"{RIG} level=99", "level"),
    ("inspect", f"{RIG} picture_depths=[-1]", "picture_depths: expected"),
    ("benchmark", "seconds=0", "seconds: expected a number above 0"),
    ("benchmark", "groups=[everything]", "groups: expected one of"),
)
"""Command, words, and a part of what is said."""


@pytest.mark.parametrize(("recipe", "words", "said"), FAULTS)
def test_wrong_words_are_told_in_a_paragraph(
    failing: Callable[..., str], tmp_path: Path, recipe: str, words: str, said: str
) -> None:
    save_rig(ring_rig(4, 0.2, (32, 32)), tmp_path / "capture/config.yaml")
    message = failing(recipe, *words.split()).partition("Error: ")[2].strip()
    assert said in message
    assert len(message.splitlines()) <= 2
