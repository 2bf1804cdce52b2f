# SPDX-License-Identifier: Apache-2.0
"""Wrong words on the command line: each is one paragraph and status 1, never a traceback. A new one is one line."""

from __future__ import annotations

from pathlib import Path

import pytest

from sphericalvision.cameras import ring_rig, save_rig
from sphericalvision.core import ArgumentError
from sphericalvision.recipes.commands.train import instantiate_run
from tests.recipes.tiny import TINY_SCENES, TINY_TRAINING, Run, composed

SHORT = {
    "RIG": "calibration=capture/config.yaml",
    "X": "calibration=capture/config.yaml images=x",
    "EACH": "calibration=capture/config.yaml images={camera}.png",
    "SWEEP_ALONE": "models.icosweepnet=null models.omnimvs=null models.constant=null data.samples_per_pixel=1",
    "UNTURNED": f"experiment=quickstart data=fisheye_scenes data.panorama_size=[8,16] {' '.join(TINY_SCENES)}",
    "PANORAMAS": "rig=equirect4 rig.image_size=[16,32] height=16 samples_per_pixel=1",
}
"""What a word in capitals stands for."""

WRONG_VALUES = """
train | | seed= seed=1.5 seed=true seed=[1] tags=mine data.batch_size=0 data.batch_size=two trainer.max_steps=-2
train | | trainer.max_steps=1.5 trainer.max_time=long trainer.num_nodes=0 trainer.devices=0.5 trainer.devices=0
train | | trainer.devices=[] trainer.devices=many trainer.accumulate_grad_batches=0 trainer.gradient_clip_val=-1
train | | trainer.accelerator=fast trainer.use_distributed_sampler=true trainer.val_check_interval=0.5
train | | trainer.profiler=fast trainer.check_val_every_n_epoch=1 trainer.limit_val_batches=1.5
train | | trainer.overfit_batches=1.5
render | output=x | num_frames=many num_frames=0 samples_per_pixel=0 height=-3 scale=0 first_seed=-1 release=jpg
render | output=x | mesh_up=x num_workers=many
predict | X | level=two num_hypotheses=1 photometric=maybe skip_existing=maybe frames=[] cameras=[] method=fast
predict | X | on_error=ignore min_depth=near min_depth=inf max_angle_deg=400 translation_unit=inch device=gpu output=
predict | X | height=[ height=0 frames=3 min_depth=[1] trained_radius=0 max_angle_deg=wide
predict | RIG | images=
predict | images=x | calibration=
inspect | RIG | level=-1 level=99 picture_depths=[-1] depths=[] depths=[0] depths=[nan] cameras=[] depths=[far]
convert | | calibration=
convert | RIG | fit_angle_deg=0 max_angle_deg=1000 translation_unit=inch camera=nobody
calibrate | images=*.png board=7x5 square=0.03 | field_of_view_deg=400 to=no_model
calibrate | images=*.png board=7x5 | square=0
calibrate | images=*.png square=0.03 | board=seven
evaluate | | split=all data.num_test=two
benchmark | | tracks=[rooms] methods=[] frames=0 first_frame=-1
align | X | format=pdf
study | | seeds=[] panorama_size=[8] on_change=ask
study | study=tiny | angles_deg=[0,0] models.constant.kind=magic
study | study=tiny SWEEP_ALONE | panel_frame=2
speed | settings=[[3,4]] feature_channels=2 image_size=[32,32] | options=[fp8] only=regresion only=(
speed | | seconds=0 groups=[everything] settings=[[5]] settings=[5,16] image_size=[32]
"""
"""Command, words before, and wrong words: the answer to each begins with its key, what is expected and what came."""

MISTAKES = """
train | modle=icosweepnet | modle: there is no such key
train | model=icosweepnett | known are icosweepnet
train | optimizer.learning_rate=1 | optimizer.learning_rate: there is no such key
train | experiment=quickstart trainer.max_step=3 | did you mean trainer.max_steps
train | callbacks.panels.num_frame=3 | did you mean callbacks.panels.num_frames
train | model.output_size=[20,40] | is a key of model=omnimvs,
train | data=omnistereo data.root=x data.tilts_deg=[0,9] | is a key of data=fisheye_scenes,
train | data=omnistereo data.root=x data.tilts_degs=[0,9] | in this configuration; data has entries,
train | data=random_rigs_levels data.levels.5.times=1 | write 'data.levels={5:{times:...}}'
train | data=omnithings | data.root=...
train | seed | seed: expected KEY=VALUE
train | logger=mlfow | known are
train | debug=overfitt | known are
train | trainer=null | group
train | -m trainer.devices=2 seed=0,1 | trainer.devices=2: --multirun cannot
train | -m trainer.strategy=ddp seed=0,1 | without --multirun
predict | | calibration=...
predict | RIG | images=...
predict | rig=ring | rig: there is no such key
evaluate | chekpoint=x | did you mean checkpoint
evaluate | checkpoint=icosweepnet-smal | or one of icosweepnet-small
render | num_frame=3 | did you mean num_frames
render | output=x ~height | height has no default
predict | X output=capture/config.yaml | output: cannot write to the folder capture/config.yaml
predict | X output=/proc | output: cannot write to the folder /proc
predict | RIG images | images: expected KEY=VALUE
predict | =3 | --help
predict | EACH | images: '{camera}.png' has no files of each of
predict | EACH masks={camera}_m.png | masks: '{camera}_m.png' has no files of each of
predict | --hepl | did you mean --help
predict | --cfg | --cfg
predict | --cfg everything | choose from 'job'
predict | --info defalts | choose from 'all'
predict | --config-dir nowhere | --config-dir: nowhere is no folder
predict | --config-dir nowhere --help | --config-dir: nowhere is no folder
predict | -m heigth=3,4 | did you mean height
inspect | calibration=none.yaml | none.yaml: no such file or folder
convert | RIG output=. | output: . is a folder
convert | RIG to=pinhole fit_angle_deg=100 | fit_angle_deg: a PinholeCamera ends before 90
convert | RIG to=kanala_brandt | 'kannala_brandt'
convert | RIG camera=cam1 format=docx output=a | colmap
convert | | calibration=...
render | output=x kind=garden | kind: expected one of
evaluate | checkpoint=nowhere.ckpt | nowhere.ckpt: no such file
evaluate | checkpoint=capture/half.ckpt | half.ckpt: is not a checkpoint of sphericalvision-train
evaluate | checkpoint=capture/notes.txt | .safetensors
evaluate | checkpoint=icosweepnet-small device=nonsense | device: expected
evaluate | checkpoint=icosweepnet-small data.augment=true | data.augment: counts only in training
evaluate | data=omnihouse data.root=x rig.image_size=[8,8] | rig.image_size: counts only with
evaluate | data=random_rigs photometric=true | samples of RandomRigDataModule do not hold
evaluate | checkpoint=icosweepnet-small data=kitti360 data.root=capture | data.test
evaluate | rig=capture/config.yaml | rig=file rig.path=...
predict | X window=5 | window: counts only with poses=...
predict | X preset=paper | known are fast, fine, finest, live
study | study=fast | known are paper, random_tilts, small, tiny
study | study=tiny models.semi_global=null models.semi_global.label=x | does not count with the options
study | study=tiny +models.semi_global.steps=2 | models.semi_global: expected one of
study | study=tiny models.constant.train=null | models.constant.train: a constant depth map
study | study=tiny extra_training=['optimizer.speed=1'] | optimizer.speed
study | study=tiny data=omnihouse data.root=x inputs=equirect | takes rendered scenes
calibrate | board=9x6 square=0.03 images=nothing/*.png | nothing/*.png
calibrate | board=9x6 images=x | square: expected
calibrate | board=target.yaml square=0.03 images=x | square: the target file target.yaml says it
calibrate | board=9x6 square=0.03 images=x dictionary=5X5_50 | dictionary: counts only with marker
benchmark | methods=[winner-takes-all,winner-takes-all] | methods: winner-takes-all is given twice
render | output=x num_frames=1 PANORAMAS release=png | release='tiff'
train | experiment=spherical_digits data.orientation=tilted | expected one of 'upright', 'rotated'
train | experiment=spherical_digits model.level=2 | level: expected 3 or more
train | experiment=quickstart resume=capture/half.ckpt | half.ckpt is not a checkpoint
train | experiment=quickstart hydra.job.chdir=true | hydra.job.chdir:
train | scene_rig=ring | scene_rig: there is no such key
train | scheduler=linear | scheduler=linear: there is no such option
train | data=spirs | known are capture,
train | experiment=quickstart data.val_seed=10 | data.val_seed
train | UNTURNED data.cache_dir=null trainer.max_steps=1 | data.panorama_size: turning by multiples of 72
train | experiment=quickstart rig.image_size=[32,32] data.kind=garden | expected one of
"""
"""Command, words, and a part of what is said."""


def rows(table: str) -> list[list[str]]:
    """The cells of a table, a row a line."""
    return [[cell.strip() for cell in line.split("|")] for line in table.strip().splitlines()]


def expected(words: str) -> list[tuple[str, str]]:
    """Each of some words with wrong values, and what the answer begins with."""
    return [(word, f"{word.partition('=')[0]}: expected ") for word in words.split()]


FAULTS = [
    *(
        (recipe, f"{words} {wrong}", said)
        for recipe, words, v in rows(WRONG_VALUES)
        for wrong, said in expected(v)
    ),
    *map(tuple, rows(MISTAKES)),
]


def write_wrong_files(folder: Path) -> None:
    """A calibration, and files that are no checkpoints."""
    save_rig(ring_rig(4, 0.2, (32, 32)), folder / "capture/config.yaml")
    (folder / "capture/half.ckpt").write_bytes(b"PK\x03\x04 half a file")
    (folder / "capture/notes.txt").write_text("?")


@pytest.mark.parametrize(("recipe", "words", "said"), FAULTS)
def test_wrong_words_are_told_in_a_paragraph(
    failing: Run, tmp_path: Path, recipe: str, words: str, said: str
) -> None:
    write_wrong_files(tmp_path)
    words = " ".join(SHORT.get(word, word) for word in words.split())
    message = failing(recipe, *words.split()).partition("Error: ")[2].strip()
    assert said in message
    assert len(message.splitlines()) <= 2


WRONG_PARTS = """
data.num_train=0 data.train_seed=-1 data.panorama_size=[4] data.samples_per_pixel=0 data.entries=[] data.mesh_up=x
rig.num_cameras=0 rig.image_size=[32] rig.field_of_view_deg=400 model.level=two
trainer.precision=half loss.delta=small callbacks.panels.num_frames=-1
"""
"""Words of a training that the parts refuse which take them, before it starts; what is said begins as above."""

REFUSED = """
trainer.strategy=dpp trainer.accelerator=cpu | trainer:
trainer.strategy=fsdp trainer.accelerator=cpu | trainer:
trainer.accelerator=cpu trainer.devices=[0] | trainer:
model.norm=layer | norm: expected one of
model._target_=nothing.at.all | model._target_: 'nothing.at.all' cannot be imported
optimizer.betas=[1,2] | optimizer
optimizer.lr=nan | optimizer
optimizer.lr=-1 | optimizer
optimizer.lr=fast | optimizer.lr: expected a number
model.num_hypotheses=many | model.num_hypotheses: expected a whole number, got 'many'
+data.nunber=1 | data.nunber:
scheduler=step scheduler.milestones=100 | scheduler
callbacks.best.mode=most | callbacks.best
callbacks.last.train_time_interval.minutes=often | callbacks.last
callbacks=early_stopping callbacks.early_stopping.patience=few | callbacks.early_stopping.patience
logger=csv logger.csv.save_dir=null | logger.csv.save_dir: expected
"""
"""Words of a training, and a part of what is said."""


@pytest.mark.parametrize(("words", "said"), [*expected(WRONG_PARTS), *rows(REFUSED)])
def test_wrong_words_are_told_by_the_part_that_takes_them(tmp_path: Path, words: str, said: str) -> None:
    config = composed("train", *TINY_TRAINING, *words.split())
    with pytest.raises(ArgumentError) as raised:
        instantiate_run(config, tmp_path)
    assert said in str(raised.value)
    assert len(str(raised.value).splitlines()) <= 2
