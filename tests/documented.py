# SPDX-License-Identifier: Apache-2.0
"""What the documentation's blocks say, what a reader brings, and the words that make command lines small."""

import re
import shlex
import sys
import time
from collections.abc import Iterator
from contextlib import nullcontext, suppress
from importlib import import_module
from pathlib import Path
from typing import NamedTuple

import pytest
import torch
import trimesh
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import MissingMandatoryValue

from sphericalvision.cameras import CameraRig, ring_rig
from sphericalvision.data import write_omnistereo
from sphericalvision.io.images import read_image, write_image
from sphericalvision.models import IcoSweepNet, save_weights
from sphericalvision.recipes.app.checks import check_keys
from sphericalvision.recipes.app.running import config_space
from sphericalvision.recipes.app.words import first_values, read_words
from tests.recipes.board_pictures import write_boards
from tests.recipes.scanned_sets import PUBLISHED
from tests.recipes.tiny import TINY_BENCHMARK, write_streams
from tests.worlds import recorded_frames

__all__ = [
    "PAGES",
    "ROOT",
    "Block",
    "Command",
    "blocks",
    "bring",
    "commands_of",
    "composed",
    "mentioned_in",
    "run_command",
    "write_data_sets",
]

ROOT = Path(__file__).resolve().parents[1]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
FENCE = re.compile(
    r"^(?P<indent> *)```(?P<info>[^\n`]+)\n(?P<body>.*?)^(?P=indent)```", re.DOTALL | re.MULTILINE
)
PROGRAM = re.compile(r"^(?:sphericalvision-|python -m sphericalvision\.recipes\.)(\w+)(?: |$)")
HIDDEN = "markdown-exec: hide"
"""Marks lines that a page runs and does not show."""
SIZE = (32, 32)
TARGET = "target_type: checkerboard\ntargetCols: 7\ntargetRows: 5\nrowSpacingMeters: 0.05\ncolSpacingMeters: 0.05\n"
"""The board of the pictures, as Kalibr describes one."""


class Block(NamedTuple):
    """A fenced block of a page."""

    language: str
    title: str
    body: str


class Command(NamedTuple):
    """A command line of the documentation: the recipe, and its words."""

    recipe: str
    words: list[str]


def blocks(page: Path, *languages: str, visible: bool = False) -> Iterator[Block]:
    """The fenced blocks of these languages, or of all; or only what a reader sees and copies of them."""
    for match in FENCE.finditer(page.read_text()):
        info, indent = match["info"], len(match["indent"])
        language, shown = info.split()[0], 'exec="true"' not in info or "source=" in info
        if (not languages or language in languages) and (shown or not visible):
            title = re.search(r'title="([^"]+)"', info)
            lines = [
                line[indent:] for line in match["body"].splitlines() if not visible or HIDDEN not in line
            ]
            yield Block(language, title[1] if title else "", "\n".join(lines))


def commands_of(script: str) -> list[Command]:
    """The command lines of this package in a shell block, continuation lines joined."""
    lines = (line.strip() for line in script.replace("\\\n", " ").splitlines())
    matches = [(line, match) for line in lines if (match := PROGRAM.match(line))]
    return [Command(match[1], shlex.split(line[match.end() :], comments=True)) for line, match in matches]


def mentioned_in(page: Path) -> list[Command]:
    """The command lines within sentences of a page, and in the comments of a YAML file."""
    commands = []
    text = re.sub(r"\\\n#? *", "", page.read_text())
    pattern = (
        r"^#.*?(sphericalvision-\w+ [^#]*?)(?: {3,}\(.*)?$"
        if page.suffix == ".yaml"
        else r"`(sphericalvision-\w+ [^`]*)`"
    )
    for line in re.findall(pattern, text, re.MULTILINE):
        program, *words = shlex.split(re.sub(r"<[^>]*>", "x", re.sub(r"\s+", " ", line)))
        if any("=" in word for word in words):
            commands.append(Command(program.removeprefix("sphericalvision-"), [w for w in words if w != "…"]))
    return commands


def bring(folder: Path) -> None:
    """What a reader brings, as no page renders it: boards, a drive, a scan, weights and data sets."""
    torch.manual_seed(0)
    lenses = []
    for name, aside in (("board", 0.0), ("boards/front", 0.0), ("boards/back", 0.03)):
        write_boards(folder / name, aside)
        pictures = (read_image(file) for file in sorted((folder / name).glob("*.png")))
        lenses.append([(255 * picture).byte().movedim(0, -1).numpy() for picture in pictures])
    for name in ("VID_board", "VID", "walk"):
        write_streams(folder / f"{name}.insv", lenses[1:])
    (folder / "target.yaml").write_text(TARGET)
    trimesh.creation.box((6.0, 2.5, 5.0)).export(folder / "room.glb")
    rig = ring_rig(4, 0.2, SIZE)
    for name in rig.names:
        for frame in range(5):
            write_image(folder / "drive" / name / f"{frame}.png", torch.rand(3, *SIZE))
    poses = "".join(f"{frame} 0 {0.2 * frame} 0 0 0 0 1\n" for frame in range(5))
    (folder / "drive" / "poses.txt").write_text(poses)
    net = IcoSweepNet(3, 4, feature_channels=2, aggregation="variance", norm="instance")
    for name in ("network", "weights/icosweepnet-0"):
        save_weights(net, folder / f"{name}.safetensors")
    write_data_sets(folder / "data", rig)


def write_data_sets(folder: Path, rig: CameraRig) -> None:
    """Recorded and rendered data sets under the names that the documentation gives them."""
    for name, frames in (("omnithings", [1, 2, 8241]), ("omnihouse", [1, 2]), ("mine", [1, 2])):
        write_omnistereo(folder / name, recorded_frames(rig, frames, height=20), rig)
    for write in PUBLISHED:
        write(folder / write.__name__.removeprefix("write_"))


def run_command(command: Command, folder: Path, cache: Path) -> None:
    """Run a command line in ``folder``, made small; ``/data`` of its words is the folder's."""
    words = [re.sub(r"=\.\.\.$", "=/data/omnithings", word) for word in command.words]
    words = [re.sub(r"(?<==)/data/", f"{folder}/data/", word) for word in words]
    if command.recipe == "train":
        time.sleep(1)  # folders of runs are named by the second, and these are short
    options = next((number for number, word in enumerate(words) if word.startswith("--")), len(words))
    words[options:options] = smaller(command.recipe, words, cache)  # options such as --cfg job end the keys
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.setattr("sys.argv", [f"sphericalvision-{command.recipe}", *words])
        patch.setenv("WANDB_SILENT", "true")
        patch.setenv("PYTHONPATH", "")
        patch.setattr("sys.path", [*sys.path])
        import_module(f"sphericalvision.recipes.{command.recipe}").main()


def smaller(recipe: str, words: list[str], cache: Path) -> list[str]:
    """Words that make a command small: few and small frames, few steps, narrow networks."""
    if recipe == "speed":
        return BENCHMARK
    if recipe in ("align", "convert", "calibrate", "export"):
        return []
    if recipe == "benchmark":
        return [*TINY_BENCHMARK, f"cache_dir={cache}"]
    config = composed(recipe, words)
    if recipe == "inspect":
        return ["level=3"]
    if recipe == "predict":  # alignment takes most of the time of small images, which say nothing about poses
        return PREDICT if any(word.startswith("align=") for word in words) else [*PREDICT, "align=false"]
    if recipe == "render":
        return ["rig.image_size=[32,32]", "samples_per_pixel=1", "height=32", "num_frames=2", "num_workers=0"]
    data = data_words(config.data, cache)
    if recipe == "evaluate":
        # the network that ships is for images of level 6, and takes level 5 at least
        return [*data, "model.level=5", "device=cpu"]
    if config.get("init_weights") == "refinedsweepnet":
        return [*data, "model.level=5", *TRAINING]
    if recipe == "train":
        return [*data, *network_words(config.model), *TRAINING]
    panoramas = ["equirect_size=[32,64]"] if config.inputs == "equirect" else []
    return [*data, *STUDY, *panoramas, *study_words(config, cache)]


def composed(recipe: str, words: list[str], whole: bool = True) -> DictConfig:
    """The config of a command line; of a sweep, that of its first run. One that is not whole may lack values."""
    from hydra import compose

    line = read_words(words, pytest.fail)
    overrides = first_values(line.overrides) if line.multirun else line.overrides
    with config_space(line.config_dir):
        config = compose(recipe, overrides)
        with nullcontext() if whole else suppress(MissingMandatoryValue):
            check_keys(import_module(f"sphericalvision.recipes.{recipe}").main.keys, config, overrides)
        return config


def data_words(data: DictConfig, cache: Path) -> list[str]:
    """Few samples of any data module."""
    words = ["data.num_workers=0"]
    target = str(OmegaConf.to_container(data)["_target_"])
    if target.endswith("LabelledRoomsDataModule"):
        sizes = ["data.num_train=3", "data.num_val=1", "data.num_test=1", "data.batch_size=1"]
        words += [*sizes, f"data.cache_dir={cache}"]
    elif "num_train" in data:
        if "rig" in data:
            size = "[32,64]" if "equirect" in str(data.rig) else "[32,32]"
            words += [] if "path" in data.rig else [f"rig.image_size={size}"]
        else:
            words += ["data.image_size=[32,32]", "data.levels=null", "data.clues=null"]
        words += ["data.num_train=3", "data.num_val=1", "data.num_test=2", "data.samples_per_pixel=1"]
        words += [f"data.cache_dir={cache}", "data.batch_size=1"]
    elif target.endswith("DigitsDataModule"):
        words += ["data.num_val=8", "data.num_test=8", "data.batch_size=4"]
    elif "truth_height" in data:
        words += ["data.truth_height=32", *(["data.spacing=0.1"] if "spacing" in data else [])]
    else:
        words += ["data.batch_size=1", *(["data.missing=skip"] if "missing" in data else [])]
    return words


def study_words(config: DictConfig, cache: Path) -> list[str]:
    """Small trainings of the models of a study, in one process each."""
    words = []
    common = [*map(str, config.extra_training), *TRAINING, "trainer.devices=1", "scheduler=constant"]
    for name, model in config.models.items():
        if model is None or "train" not in model or name == "constant":
            continue
        own = [*map(str, config.training), *map(str, model.train)]
        training = composed("train", own)
        added = [*network_words(training.model), *data_words(training.data, cache)]
        words.append(f"models.{name}.train={listed([*map(str, model.train), *added])}")
    own = [*map(str, config.training)]
    if "omnithings" in str(own):  # the frames that a constant depth map is the median of
        words.append(f"training={listed([*own, 'data.missing=skip'])}")
    return [*words, f"extra_training={listed(common)}"]


def listed(words: list[str]) -> str:
    """A list of words as a value of Hydra's."""
    return "[" + ",".join(f'"{word}"' for word in words) + "]"


def network_words(model: DictConfig) -> list[str]:
    """A narrow network of the same kind."""
    target = str(model._target_).rpartition(".")[2]
    if target.endswith(("Classifier", "Segmenter")):
        return ["model.level=3", "model.width=2"]
    if target in ("around", "RefinedSweepNet"):  # around: with a prior that is there
        return ["model.level=3", "model.widths=[4,4]", "model.blocks=1"]
    if target == "RomniStereo":  # 16 hypotheses or more
        return ["model.output_size=[20,40]", "model.num_hypotheses=16", "model.feature_channels=2"]
    size = ["model.output_size=[20,40]", "model.num_scales=2"] if target == "OmniMVS" else ["model.level=3"]
    return [*size, "model.num_hypotheses=4", "model.feature_channels=2"]


TRAINING = [
    "trainer.max_steps=2",
    "trainer.val_check_interval=1",
    "trainer.num_sanity_val_steps=0",
    "trainer.accelerator=cpu",
]
PREDICT = ["height=16", "level=5", "device=cpu"]
BENCHMARK = [
    "seconds=0.01",
    "settings=[[3,4]]",
    "convolution_settings=[[3,2]]",
    "feature_channels=2",
    "image_size=[32,32]",
    "num_points=100",
    "num_frames=1",
    "image_sides=[32]",
    "presets=[fast]",
    "device=cpu",
]
STUDY = [
    "angles_deg=[0,45]",
    "seeds=[0]",
    "num_hypotheses=4",
    "image_size=[32,32]",
    "panorama_size=[8,32]",
    "panel_height=40",
    "frames=2",
    "baseline_frames=3",
    "model.level=3",
]
