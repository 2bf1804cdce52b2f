# SPDX-License-Identifier: Apache-2.0
"""Wrong words on the command line: each is one paragraph and status 1, never a traceback. A new one is one line."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from hydra import compose, initialize_config_module

from sphericalvision.cameras import ring_rig, save_rig
from sphericalvision.core import ArgumentError
from sphericalvision.recipes.commands.train import instantiate_run
from tests.recipes.tiny import TINY_TRAINING

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
    ("train", "-m trainer.devices=2 seed=0,1", "trainer.devices=2: the processes of one training"),
    ("train", "-m trainer.strategy=ddp seed=0,1", "start a command for each value, without --multirun"),
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
    ("predict", "calibration= images=x", "calibration: expected text (not empty), got ''"),
    ("predict", f"{RIG} images=", "images: expected text (not empty)"),
    ("predict", f"{RIG} images=x frames=[]", "frames: expected a list of"),
    ("predict", f"{RIG} images=x cameras=[]", "cameras: expected a list of"),
    ("predict", f"{RIG} images=x method=fast", "method: expected one of network, semi_global"),
    ("predict", f"{RIG} images=x on_error=ignore", "on_error: expected one of skip, stop"),
    (
        "predict",
        f"{RIG} images=x min_depth=near",
        "min_depth: expected a number above 0 and finite or one of auto",
    ),
    ("predict", f"{RIG} images=x min_depth=inf", "min_depth: expected a number above 0 and finite"),
    ("predict", f"{RIG} images=x max_angle_deg=400", "max_angle_deg: expected a number above 0 to 180"),
    ("predict", f"{RIG} images=x translation_unit=inch", "translation_unit: expected one of m, cm, mm"),
    ("predict", f"{RIG} images=x device=gpu", "device: expected auto, cpu or cuda, got 'gpu'"),
    ("predict", f"{RIG} images=x output=", "output: expected text (not empty)"),
    ("predict", f"{RIG} images=x output={RIG.partition('=')[2]}", "is a file, so no folder can be there"),
    ("predict", f"{RIG} images=x ~height", "height: this command needs the key"),
    ("predict", f"{RIG} images", "images: expected KEY=VALUE"),
    ("predict", "=3", "expected KEY=VALUE"),
    ("predict", "height=[", "height: the value of height=[ cannot be read"),
    ("predict", f"{RIG} images={{camera}}.png", "images: no files of all 4 cameras"),
    ("predict", f"{RIG} images={{camera}}.png masks={{camera}}_m.png", "masks: no files of all 4 cameras"),
    ("predict", "--hepl", "did you mean --help"),
    ("predict", "--cfg", "--cfg: a value is needed behind it: job, hydra, all"),
    ("predict", "--cfg everything", "--cfg: expected one of job, hydra, all, got 'everything'"),
    ("predict", "--info defalts", "--info: expected one of"),
    ("predict", "--config-dir nowhere", "--config-dir: nowhere is no folder"),
    ("predict", "--config-dir nowhere --help", "--config-dir: nowhere is no folder"),
    ("predict", "-m heigth=3,4", "did you mean height"),
    ("inspect", f"{RIG} depths=[]", "depths: expected a list of numbers above 0 (not empty)"),
    ("inspect", f"{RIG} depths=[nan]", "depths: expected a list of numbers above 0"),
    ("inspect", f"{RIG} cameras=[]", "cameras: expected a list of"),
    ("inspect", "calibration=none.yaml", "none.yaml: no such file or folder"),
    ("convert", "calibration=", "calibration: expected text (not empty)"),
    ("convert", f"{RIG} output=.", "output: . is a folder, a file is expected"),
    ("convert", f"{RIG} to=pinhole fit_angle_deg=100", "fit_angle_deg: a PinholeCamera ends before 90"),
    ("convert", f"{RIG} fit_angle_deg=0", "fit_angle_deg: expected a number above 0 to 180"),
    ("convert", f"{RIG} max_angle_deg=1000", "max_angle_deg: expected a number above 0 to 180"),
    ("convert", f"{RIG} translation_unit=inch", "translation_unit: expected one of m, cm, mm"),
    ("convert", f"{RIG} camera=nobody", "camera: expected one of cam1"),
    (
        "calibrate",
        "images=*.png board=7x5 square=0.03 field_of_view_deg=400",
        "field_of_view_deg: expected a number",
    ),
    ("calibrate", "images=*.png board=7x5 square=0", "square: expected a number above 0"),
    ("calibrate", "images=*.png board=seven square=0.03", "board: "),
    ("render", "release=jpg", "release: expected one of png, tiff"),
    ("render", "mesh_up=x", "mesh_up: expected one of y, z"),
    ("render", "num_frames=0", "num_frames: expected a whole number of 1 or more"),
    ("evaluate", "split=all", "split: expected one of train, val, test"),
    ("evaluate", "data.level=two", "data.level: expected a whole number"),
    ("evaluate", "checkpoint=icosweepnet-smal", "or one of icosweepnet-small"),
    ("study", "seeds=[]", "seeds: expected a list of whole numbers of 0 or more (not empty)"),
    (
        "study",
        "panorama_size=[8]",
        "panorama_size: expected a list of whole numbers of 1 or more (2 of them)",
    ),
    ("study", "on_change=ask", "on_change: expected one of refuse, redo"),
    ("benchmark", "settings=[[5]]", "settings: expected a list of"),
    ("benchmark", "image_size=[32]", "image_size: expected a list of"),
    ("train", "trainer=null", "trainer=null: this group cannot be left out"),
    ("train", "trainer.devices=0", "trainer.devices: expected one of auto"),
    ("train", "trainer.devices=[]", "trainer.devices: expected one of auto"),
    ("train", "trainer.devices=many", "trainer.devices: expected one of auto"),
    ("train", "trainer.accelerator=fast", "trainer.accelerator: expected one of auto, cpu, gpu"),
    ("train", "trainer.precision=half", "trainer.precision: expected one of 32-true, 16-mixed"),
    ("train", "trainer.max_time=long", "trainer.max_time: expected days to seconds as 00:12:00:00"),
    ("train", "trainer.max_steps=1.5", "trainer.max_steps: expected a whole number"),
    ("train", "trainer.val_check_interval=0.5", "trainer.val_check_interval: expected a whole number"),
    ("train", "trainer.check_val_every_n_epoch=1", "trainer.check_val_every_n_epoch: expected null"),
    ("train", "trainer.limit_val_batches=1.5", "trainer.limit_val_batches: expected"),
    ("train", "trainer.overfit_batches=1.5", "trainer.overfit_batches: expected"),
    ("train", "trainer.profiler=fast", "trainer.profiler: expected one of simple, advanced"),
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


PARTS = (
    ("trainer.strategy=dpp trainer.accelerator=cpu", "trainer.strategy: expected auto, ddp, ddp_spawn"),
    ("trainer.strategy=fsdp trainer.accelerator=cpu", "trainer.strategy: fsdp is for GPUs"),
    (
        "trainer.accelerator=cpu trainer.devices=[0]",
        "trainer.devices: on a CPU, the number of processes is expected",
    ),
    ("data.level=9", "data.level: the network takes images of level 3, got 9"),
    ("data.depth_level=2", "data.depth_level: the network estimates depth at level 1, got 2"),
    ("data.num_train=0", "data.num_train: expected a whole number of 1 or more, got 0"),
    ("data.train_seed=-1", "data.train_seed: expected a whole number of 0 or more"),
    ("data.min_depth=0", "data.min_depth: expected a number above 0"),
    (
        "data.panorama_size=[4]",
        "data.panorama_size: expected a list of whole numbers of 1 or more (2 of them)",
    ),
    ("data.samples_per_pixel=0", "data.samples_per_pixel: expected a whole number of 1 or more"),
    ("data.entries=[]", "data.entries: expected a list of text (not empty)"),
    ("data.mesh_up=x", "data.mesh_up: expected one of y, z"),
    ("rig.num_cameras=0", "rig.num_cameras: expected a whole number of 1 or more"),
    ("rig.image_size=[32]", "rig.image_size: expected a list of whole numbers of 1 or more (2 of them)"),
    ("rig.field_of_view_deg=400", "rig.field_of_view_deg: expected a number above 0 to 360"),
    ("model.level=two", "model.level: expected a whole number"),
    ("model.norm=layer", "norm: expected one of"),
    ("model._target_=nothing.at.all", "model._target_: 'nothing.at.all' cannot be imported"),
    ("loss.delta=small", "loss.delta: expected a number"),
    ("optimizer.betas=[1,2]", "optimizer"),
    ("optimizer.lr=nan", "optimizer"),
    ("scheduler=step scheduler.milestones=100", "scheduler"),
    ("callbacks.panels.num_frames=-1", "callbacks.panels.num_frames: expected a whole number of 0 or more"),
    ("callbacks.best.mode=most", "callbacks.best"),
    ("callbacks.last.train_time_interval.minutes=often", "callbacks.last"),
    (
        "callbacks=early_stopping callbacks.early_stopping.patience=few",
        "callbacks.early_stopping.patience: expected",
    ),
    ("logger=csv logger.csv.save_dir=null", "logger.csv.save_dir: expected"),
)
"""Words of a training, and a part of what is said before it starts: these are found by the parts that take them."""


@pytest.mark.parametrize(("words", "said"), PARTS)
def test_wrong_words_are_told_by_the_part_that_takes_them(tmp_path: Path, words: str, said: str) -> None:
    with initialize_config_module("sphericalvision.conf", version_base="1.3"):
        config = compose("train", [*TINY_TRAINING, *words.split()])
    with pytest.raises(ArgumentError) as raised:
        instantiate_run(config, tmp_path)
    assert said in str(raised.value)
    assert len(str(raised.value).splitlines()) <= 2
