# SPDX-License-Identifier: Apache-2.0
"""An extension is one file: a camera, a format, a kind of scene, an aggregation, a network and a disturbance.

They lie in an empty folder, are found by their entry points, and used by command line without an edit in the tree.
"""

import shutil
from pathlib import Path

import pytest
import torch

from sphericalvision.io.images import write_image
from tests.processes import python

GLASS = Path(__file__).parent / "plugin/glass"

FORMAT = """
import json
from sphericalvision.cameras import CameraRig
from sphericalvision.cameras.calibration import native
from sphericalvision.cameras.calibration.formats import FileFormat
from sphericalvision.cameras.native_files import camera_to_dict

def write(rig, path):
    cameras = {name: camera_to_dict(camera) for name, camera in rig.cameras.items()}
    path.write_text(json.dumps({"odd": cameras, "poses": rig.world_from_camera.tolist()}))

def read(content, calibration):
    import torch
    for (name, values), pose in zip(content["odd"].items(), content["poses"]):
        camera = native.camera_from_dict(values, content.where)
        calibration.add(name, camera, content.where, torch.tensor(pose, dtype=torch.float64), float(camera.max_angle))

ODD = FileFormat("odd", "the odd JSON", recognizes_keys=lambda keys: "odd" in keys, read_keys=read, write_rig=write)
"""

SCENE = """
from sphericalvision.scenes.kinds.floating import random_floating_objects

def crowd(generator, clear_radius):
    return random_floating_objects(generator, clear_radius)
"""

AGGREGATION = """
from sphericalvision.sweep import Aggregation

class Mean(Aggregation):
    def __init__(self, channels):
        super().__init__(channels)

    def forward(self, volume):
        return volume.values.mean(1)
"""

DISTURBANCE = """
def haze(image, camera, amount, generator):
    return image + amount * (0.8 - image)
"""

ENTRY_POINTS = """
[sphericalvision.cameras]
equisolid_lens = odd_camera:EquisolidLens
[sphericalvision.formats]
odd = odd_format:ODD
[sphericalvision.scenes]
crowd = odd_scene:crowd
[sphericalvision.aggregations]
odd-mean = odd_aggregation:Mean
[sphericalvision.networks]
colour-variance = odd_network:ColourVariance
[sphericalvision.disturbances]
haze = odd_disturbance:haze
"""

RIG = """
from odd_camera import EquisolidLens
from sphericalvision.cameras import CameraRig, ring_rig, save_rig
lens = EquisolidLens([9.0], [15.5, 15.5], (32, 32), 1.8)
save_rig(CameraRig([lens] * 4, ring_rig(4, 0.2).world_from_camera), "rig.json", format="odd")
"""

TRAINING = (
    "experiment=quickstart",
    "data.num_train=2",
    "data.num_val=2",
    "data.samples_per_pixel=1",
    "data.num_workers=0",
    "data.cache_dir=null",
    "scheduler=constant",
    "trainer.max_steps=1",
    "trainer.val_check_interval=1",
    "trainer.accelerator=cpu",
    "logger=none",
    "callbacks.panels=null",
)


OWN_SCENES = ("rig=file", "rig.path=rig.json", "data.kind=crowd")
OWN_FAULTS = (
    "data=random_rigs",
    "+data.world.kind.crowd=1",
    "data.image_size=[32,32]",
    "+data.world.faults.haze=[1.0,0.5]",
)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """An empty folder but for the files of the extensions, and a configuration that names the network."""
    site = tmp_path / "site"
    (site / "odd-1.0.dist-info").mkdir(parents=True)
    (site / "odd-1.0.dist-info/METADATA").write_text("Metadata-Version: 2.1\nName: odd\nVersion: 1.0\n")
    (site / "odd-1.0.dist-info/entry_points.txt").write_text(ENTRY_POINTS)
    for name, text in (
        ("format", FORMAT),
        ("scene", SCENE),
        ("aggregation", AGGREGATION),
        ("disturbance", DISTURBANCE),
    ):
        (site / f"odd_{name}.py").write_text(text)
    for name in ("camera", "network"):
        shutil.copy(GLASS / f"{name}.py", site / f"odd_{name}.py")
    (tmp_path / "conf/model").mkdir(parents=True)
    (tmp_path / "conf/model/odd.yaml").write_text(
        "_target_: odd_network.ColourVariance\nlevel: 3\nnum_hypotheses: 4\nmin_depth: 0.55\nwidth: 3\n"
    )
    return tmp_path


def command(folder: Path, name: str, *words: str) -> str:
    return python("-m", f"sphericalvision.recipes.{name}", *words, folder=folder, path=folder / "site")


@pytest.mark.slow
def test_extensions_of_one_file_each_work_from_every_command(folder: Path) -> None:
    python("-c", RIG, folder=folder, path=folder / "site")
    command(folder, "convert", "calibration=rig.json", "output=rig.yaml")
    assert "equisolid_lens" in (folder / "rig.yaml").read_text()
    command(folder, "convert", "calibration=rig.yaml", "output=again.json", "format=odd")
    assert '"odd"' in (folder / "again.json").read_text()

    words = ("rig=ring", "rig.image_size=[32,32]", "height=16", "samples_per_pixel=1")
    command(folder, "render", "output=set", "kind=crowd", "num_frames=1", *words)
    assert list((folder / "set").rglob("*.png"))

    small = (
        "model.level=3",
        "model.num_hypotheses=4",
        "model.feature_channels=2",
        "model.aggregation=odd-mean",
    )
    command(folder, "train", *TRAINING, *OWN_FAULTS, "output=mean", "model=icosweepnet", *small)
    command(folder, "train", "--config-dir", "conf", *TRAINING, *OWN_SCENES, "output=run", "model=odd")
    for number in range(1, 5):
        write_image(folder / f"cam{number}.png", torch.rand(3, 32, 32))
    for run in ("mean", "run"):
        weights = f"checkpoint={run}/checkpoints/last.safetensors"
        words = (
            "calibration=rig.json",
            "images=cam{camera}.png",
            f"output={run}/depth",
            "height=16",
            weights,
        )
        command(folder, "predict", *words)
        assert (folder / run / "depth/depth.npz").is_file()

    sizes = ("level=3", "panorama_rows=8", "image_rows=24", "frames=1", "workers=0", "cache_dir=null")
    words = (
        "preparation=none",
        "methods=[constant]",
        "tracks=[haze]",
    )
    command(folder, "benchmark", "output=compared", *words, *sizes)
    assert list((folder / "compared").rglob("haze*"))
