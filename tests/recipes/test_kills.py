# SPDX-License-Identifier: Apache-2.0
"""``kill -9`` at random moments of four commands leaves nothing half written and the same result; and full disks.

``SPHERICALVISION_KILLS`` is how often each command is killed, ``SPHERICALVISION_SEED`` chooses other moments. Disks are
small file systems in memory, which root may mount; elsewhere their tests are skipped.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import random
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import torch

from sphericalvision.cameras import ring_rig
from sphericalvision.io.images import read_image
from sphericalvision.scenes import make_scene, render_rig
from tests.recipes.conftest import run_recipe
from tests.recipes.test_train import same, stored
from tests.recipes.tiny import TINY_TRAINING, Run, typed, write_capture

pytestmark = pytest.mark.slow

KILLS = int(os.environ.get("SPHERICALVISION_KILLS", "5"))
SEED = int(os.environ.get("SPHERICALVISION_SEED", "0"))

COMMANDS = {
    "train": [
        *TINY_TRAINING,
        *typed("trainer.max_steps=30 resume=auto logger=none data.cache_dir=scenes"),
    ],
    "render": [*typed("rig=ring rig.image_size=[48,48] num_frames=12 samples_per_pixel=1 height=48")],
    "predict": [
        *typed("calibration=capture/rig.yaml images=capture/{camera}/{frame:03d}.png method=semi_global"),
        *typed("level=4 min_depth=0.5 height=48 skip_existing=true"),
    ],
    "study": [*typed("study=tiny data.cache_dir=scenes")],
}
# What differs from run to run: times, places, and what tells how a run went.
VARY = (".lock", "config.yaml", ".log", "events", ".pt", "multirun.yaml")


@pytest.fixture
def capture(tmp_path: Path) -> Path:
    """A rig and a few frames."""
    rig = ring_rig(3, image_size=(32, 32))
    frames = (render_rig(make_scene("bare", seed=seed), rig) for seed in range(8))
    write_capture(tmp_path / "capture", rig, *frames, file="{camera}/{frame:03d}.png")
    return tmp_path


def child(folder: Path, recipe: str, words: list[str]) -> None:
    with (folder / "said.txt").open("w") as file:
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
        run_recipe(folder, recipe, *words)


def started(folder: Path, recipe: str, words: list[str]) -> multiprocessing.Process:
    """A process of its own, from one that has imported everything already."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["tests.recipes.conftest", f"sphericalvision.recipes.commands.{recipe}"])
    process = context.Process(target=child, args=(folder, recipe, words))
    process.start()
    return process  # type: ignore[return-value]


def whole(folder: Path) -> None:
    """Every file under a final name can be read."""
    for path in folder.rglob("*"):
        if path.name.startswith(".") or not path.is_file():
            continue  # left by whoever was killed, under a name of its own
        if path.suffix == ".png":
            read_image(path)
        elif path.suffix == ".ckpt":
            torch.load(path, weights_only=True)
        elif path.suffix in (".ply", ".npz", ".json", ".csv", ".safetensors"):
            assert path.stat().st_size, path


def results(folder: Path) -> dict[str, bytes]:
    """Contents of the files that a run is for; metrics along the way have a folder for each start."""
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and not path.name.startswith(".") and not path.name.endswith(VARY)
        if "metrics" not in path.relative_to(folder).parts
    }


def same_weights(first: Path, second: Path) -> None:
    assert same(stored(first), stored(second))


def same_files(suffixes: tuple[str, ...]) -> Callable[[Path, Path], None]:
    def compare(first: Path, second: Path) -> None:
        left, right = (
            {name: content for name, content in results(path).items() if name.endswith(suffixes)}
            for path in (first, second)
        )
        assert left
        assert left == right

    return compare


SAME = {
    "train": same_weights,
    "render": same_files((".png", ".txt", ".tiff")),
    "predict": same_files((".png", ".ply")),
    "study": same_files((".csv",)),
}


@pytest.mark.parametrize("recipe", COMMANDS)
def test_kills_leave_nothing_half_done(recipe: str, capture: Path) -> None:
    words = COMMANDS[recipe]
    began = time.monotonic()
    straight = started(capture, recipe, [*words, f"output={capture}/straight"])
    straight.join()
    assert straight.exitcode == 0, (capture / "said.txt").read_text()
    took = time.monotonic() - began
    chance, kills, goes = random.Random(f"{SEED} {recipe}"), 0, 0
    output = capture / "killed"
    while kills < KILLS:
        process = started(capture, recipe, [*words, f"output={output}"])
        process.join(chance.uniform(0.05, 0.9) * took)
        assert process.exitcode in (None, 0), (capture / "said.txt").read_text()
        if process.exitcode is None:
            os.kill(process.pid or 0, signal.SIGKILL)
            kills += 1
        process.join()
        whole(output)
        goes += 1
        assert goes < 10 * KILLS, "it ends before it can be killed"
        if process.exitcode == 0 and kills < KILLS:  # it is done: once more from the beginning, and sooner
            output, took = capture / f"killed{goes}", 0.7 * took
    last = started(capture, recipe, [*words, f"output={output}"])
    last.join()
    said = (capture / "said.txt").read_text()
    assert last.exitcode in (0, 1), said
    assert last.exitcode == 0 or "Error" not in said, said
    whole(output)
    SAME[recipe](capture / "straight", output)


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


WRITERS = {
    **{name: COMMANDS[name] for name in ("render", "predict", "train")},
    "convert": ["calibration=capture/rig.yaml", "to=kannala_brandt"],
    "inspect": ["calibration=capture/rig.yaml", "level=3"],
}
STATES = {
    "full": (("size=64k",), "No space left on device"),
    "read-only": (("size=1m", "ro"), "Read-only file system"),
    "a file": ((), "file"),
}
"""What is where a folder should be -> options of its file system, and what the system says."""


@pytest.mark.parametrize("state", STATES)
@pytest.mark.parametrize("command", WRITERS)
def test_where_nothing_can_be_written_one_paragraph_says_so(
    state: str, command: str, failing: Run, disk: Callable[..., Path], capture: Path
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
    assert reason in failing(command, *WRITERS[command], f"output={folder / name}")
    empty = [path.name for path in folder.rglob("*") if path.is_file() and not path.stat().st_size]
    assert set(empty) <= {".lock"}


def test_frames_of_a_disk_that_was_full_are_rendered_again(
    run: Run, failing: Run, disk: Callable[..., Path], capture: Path
) -> None:
    folder = disk("size=60k")
    words = [*COMMANDS["render"], "num_frames=2", "rig.image_size=[64,64]", "height=64"]
    assert "No space left on device" in failing("render", *words, f"output={folder}/set")
    subprocess.run(["mount", "-o", "remount,size=4m", str(folder)], check=True)
    run("render", *words, f"output={folder}/set")
    run("render", *words, "output=set")
    files = sorted(path.relative_to(capture / "set") for path in (capture / "set").rglob("*.png"))
    assert files
    for file in files:
        assert torch.equal(read_image(folder / "set" / file), read_image(capture / "set" / file))
