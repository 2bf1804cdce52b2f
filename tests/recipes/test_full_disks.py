# SPDX-License-Identifier: Apache-2.0
"""Disks that are full or read-only, and files where folders should be, for real: one paragraph from every command.

Small file systems in memory are mounted for it, which takes root; elsewhere these tests are skipped.
"""

from __future__ import annotations

import contextlib
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import torch

from sphericalvision.cameras import ring_rig
from sphericalvision.io.images import read_image
from sphericalvision.scenes import make_scene, render_rig
from tests.recipes.tiny import TINY_TRAINING, Run, write_capture

pytestmark = pytest.mark.slow

CALIBRATION = "calibration=capture/rig.yaml"
IMAGES = "images=capture/{camera}.png"
COMMANDS = {
    "render": ["rig=ring", "rig.image_size=[64,64]", "num_frames=2", "samples_per_pixel=1", "height=64"],
    "predict": [CALIBRATION, IMAGES, "method=semi_global", "level=4", "min_depth=0.5"],
    "convert": [CALIBRATION, "to=kannala_brandt"],
    "inspect": [CALIBRATION, "level=3"],
    "train": [*TINY_TRAINING, "trainer.max_steps=1"],
}


@pytest.fixture
def capture(tmp_path: Path) -> Path:
    """A rig and one image of each of its cameras."""
    rig = ring_rig(4, image_size=(32, 32))
    write_capture(tmp_path / "capture", rig, render_rig(make_scene("bare", seed=1), rig), file="{camera}.png")
    return tmp_path


def mounted(folder: Path, *options: str) -> None:
    folder.mkdir(exist_ok=True)
    words = ["mount", "-t", "tmpfs", "-o", ",".join(options), "tmpfs", str(folder)]
    try:
        done = subprocess.run(words, capture_output=True, text=True, timeout=60)
    except OSError as error:
        pytest.skip(f"no file systems can be mounted here: {error}")
    if done.returncode:
        pytest.skip(f"no file systems can be mounted here: {done.stderr.strip()}")


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Callable[..., Path]]:
    """Mount a file system in memory with these options; gives its folder."""
    folder = tmp_path / "disk"

    def mount(*options: str) -> Path:
        mounted(folder, *options)
        return folder

    yield mount
    if folder.is_mount():
        subprocess.run(["umount", "-l", str(folder)], check=False)


STATES = {
    "full": (("size=64k",), "No space left on device"),
    "read-only": (("size=1m", "ro"), "Read-only file system"),
    "a file": ((), "file"),
}
"""What is where a folder should be -> options of its file system, and what the system says."""


@pytest.mark.parametrize("state", STATES)
@pytest.mark.parametrize("command", COMMANDS)
def test_where_nothing_can_be_written_one_paragraph_says_so(
    state: str, command: str, failing: Callable[..., str], disk: Callable[..., Path], capture: Path
) -> None:
    options, reason = STATES[state]
    folder = disk(*options) if options else capture / "file"
    if state == "full":
        with contextlib.suppress(OSError), (folder / "fill").open("wb", buffering=0) as file:
            while True:
                file.write(bytes(4096))
    elif state == "a file":
        folder.write_text("here")
    name = "converted.yaml" if command == "convert" else "out"
    assert reason in failing(command, *COMMANDS[command], f"output={folder / name}")
    empty = [path.name for path in folder.rglob("*") if path.is_file() and not path.stat().st_size]
    assert set(empty) <= {".lock"}


def test_frames_of_a_disk_that_was_full_are_rendered_again(
    run: Run, failing: Callable[..., str], disk: Callable[..., Path], capture: Path
) -> None:
    folder = disk("size=60k")
    words = [*COMMANDS["render"], f"output={folder}/set"]
    assert "No space left on device" in failing("render", *words)
    subprocess.run(["mount", "-o", "remount,size=4m", str(folder)], check=True)
    run("render", *words)
    run("render", *COMMANDS["render"], "output=set")
    files = sorted(path.relative_to(capture / "set") for path in (capture / "set").rglob("*.png"))
    assert files
    for file in files:
        assert torch.equal(read_image(folder / "set" / file), read_image(capture / "set" / file))
