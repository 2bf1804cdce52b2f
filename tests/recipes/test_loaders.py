# SPDX-License-Identifier: Apache-2.0
"""What a loader hands to the processes that prepare samples: no trainer, and nothing else of the one that trains."""

from __future__ import annotations

import io
import pickle
from pathlib import Path
from typing import Any

import pytest
import pytorch_lightning as pl
import yaml

import sphericalvision.conf
from sphericalvision.cameras import ring_rig
from sphericalvision.recipes.app.cli import build
from sphericalvision.recipes.datamodules.depth_data_module import DepthDataModule
from sphericalvision.recipes.training.loaders import Loaders
from tests.documented import write_data_sets
from tests.recipes.scanned_sets import SCENES, SEQUENCE, SITE, write_own
from tests.recipes.tiny import composed

RECORDED = ("deep360", "helvipad", "omnipus")
WORDS = {
    **{name: (f"data.root=data/{name}",) for name in RECORDED},
    "capture": (
        "data.images='place/{camera}/{frame}.png'",
        "data.calibration=place/rig.yaml",
        "data.min_depth=0.55",
        "model.level=5",
    ),
    "kitti360": (
        "data.root=data/kitti360",
        "data.spacing=0.1",
        *(f"data.{part}=[{SEQUENCE}]" for part in ("train", "val")),
    ),
    "omnistereo": ("data.root=data/omnithings", "data.dataset=omnithings", "data.missing=skip"),
    "scanned": (
        "data.images='place/{camera}/{frame}.png'",
        "data.calibration=place/rig.yaml",
        "data.points=place/scans",
        "data.lidar_pose=place/lidar.txt",
    ),
    "spires": ("data.root=data/spires", *(f"data.{part}=[{SITE}]" for part in ("train", "val"))),
    "widedepth": ("data.root=data/widedepth", *(f"data.{part}=[{SCENES[0]}]" for part in ("train", "val"))),
}
"""Where the samples are of data modules that render none."""
FOLDER = Path(sphericalvision.conf.__file__).parent / "data"
KINDS = {
    node["_target_"]: path.stem
    for path in sorted(FOLDER.glob("[a-z]*.yaml"), reverse=True)
    if "_target_" in (node := yaml.safe_load(path.read_text()))
}
"""A file of each class of data modules."""


class Trainer:
    """What loaders ask of a trainer."""

    max_steps = accumulate_grad_batches = world_size = 1
    global_rank = 0


class Samples(pickle.Pickler):
    """Refuses what belongs to the process that trains."""

    def reducer_override(self, value: Any) -> Any:
        assert not isinstance(value, (Trainer, pl.LightningDataModule, pl.LightningModule))
        return NotImplemented


@pytest.fixture(scope="module")
def furnished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder, rig = tmp_path_factory.mktemp("sets"), ring_rig(4, image_size=(32, 32))
    write_data_sets(folder / "data", rig)
    write_own(folder / "place", rig, ("00001", "00002"))
    return folder


@pytest.mark.parametrize("name", sorted(KINDS.values()))
def test_processes_that_prepare_samples_are_handed_no_trainer(
    furnished: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    monkeypatch.chdir(furnished)
    kind = {"digits": "spherical_digits", "labelled_rooms": "segmentation"}.get(
        name, "refinedsweepnet/fusion"
    )
    words = [] if kind != "refinedsweepnet/fusion" else [f"data={name}"]
    config = composed("train", f"experiment={kind}", *words, *WORDS.get(name, ()))
    data = build(config.data)
    assert not isinstance(data, DepthDataModule) or data.view.level == 5  # before a network is known
    data.bind_network(build(config.model))
    loaders = Loaders(data)
    loaders.trainer = Trainer()  # type: ignore[assignment]
    loaders.setup("fit")
    validation = loaders.val_dataloader()
    for loader in (
        loaders.train_dataloader(),
        *(validation if isinstance(validation, list) else [validation]),
    ):
        handed = loader.dataset, loader.collate_fn, loader.worker_init_fn
        Samples(io.BytesIO()).dump(handed)


def test_the_pickler_refuses_what_it_should() -> None:
    with pytest.raises(AssertionError):
        Samples(io.BytesIO()).dump({"of": [Trainer()]})
