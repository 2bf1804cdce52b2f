# SPDX-License-Identifier: Apache-2.0
"""Ten thousand damaged files for every reader: none has another error than its own, hangs, or fills the memory.

``SPHERICALVISION_EXAMPLES=200`` makes it a matter of seconds.
"""

from __future__ import annotations

import json
import os
import resource
import signal
import tempfile
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import pytest
import torch
import yaml
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

from sphericalvision.cameras import FisheyeCamera, read_cameras, ring_rig, save_camera, save_rig
from sphericalvision.core import SphericalVisionError
from sphericalvision.data.omnistereo.ground_truth import read_ground_truth, write_ground_truth
from sphericalvision.io.images import read_image, read_mask
from sphericalvision.models import IcoSweepNet, load_weights, save_weights
from sphericalvision.models.weights.checkpoints import read_network
from tests.cameras.test_damaged_files import TEXTS, read_everything

pytestmark = pytest.mark.slow

EXAMPLES = int(os.environ.get("SPHERICALVISION_EXAMPLES", "10000"))
MOST_MEMORY = 300 * 2**20
LONGEST = 60  # seconds of one file, on a machine that does much else

TOKENS = [
    b"nan", b"-1", b"1e308", b"1e400", b"0", b"9" * 30, b"9" * 5000, b"null", b"true", b"\x00", b"\xff\xfe",
    b"\xef\xbb\xbf", b"&a [*a]", b"*a", b"!!python/object/apply:os.system [id]", b"[" * 500, b"{" * 500,
    b"<!DOCTYPE a [<!ENTITY b SYSTEM 'c'>]>", b"\n", b"\t", b" ", b"#", b": ", b"- ", b",", b"]", b"}", b"'",
    b'"', b"../../x", b"1_000", b"0x10", b"1:30", b"2020-01-01",
]  # fmt: skip


class Reader(NamedTuple):
    """What is read, and by whom."""

    name: str
    content: bytes
    read: Callable[[Path], Any]


def by(*readers: Callable[[Path], Any]) -> Callable[[Path], None]:
    def read(path: Path) -> None:
        for reader in readers:
            reader(path)

    return read


def image(suffix: str, *size: int, kind: type = np.uint8) -> bytes:
    pixels = np.arange(np.prod(size), dtype=kind).reshape(size)
    return bytes(cv2.imencode(suffix, pixels)[1].tobytes())


@cache
def written() -> dict[str, bytes]:
    """Files that the package writes itself."""
    found = {}
    lens = FisheyeCamera.from_field_of_view((48, 64), 2.0)
    with tempfile.TemporaryDirectory() as place, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        folder = Path(place)
        save_rig(ring_rig(2, image_size=(48, 64)), folder / "rig.yaml")
        save_camera(lens.convert(to="ocam").camera, folder / "ocam1.txt", format="ocamcalib")
        rig = ring_rig(2, image_size=(48, 64))
        ocams = {name: camera.convert(to="ocam").camera for name, camera in rig.cameras.items()}
        save_rig(type(rig)(ocams, rig.world_from_camera), folder / "config.yaml", format="omnimvs")
        write_ground_truth(folder / "depth.png", torch.rand(16, 32), 0.55)
        write_ground_truth(folder / "depth.tiff", torch.rand(16, 32), 0.55)
        save_weights(IcoSweepNet(3, 4, feature_channels=2), folder / "net.safetensors")
        net = IcoSweepNet(3, 4, feature_channels=2)
        parts = {"architecture": "icosweepnet", "network_hyperparameters": net.hyperparameters}
        state = {f"net.{name}": value for name, value in net.state_dict().items()}
        torch.save({**parts, "state_dict": state}, folder / "net.ckpt")
        for path in folder.iterdir():
            found[path.name] = path.read_bytes()
    return found


CALIBRATIONS = [Reader(name, text.encode(), read_everything) for name, text in TEXTS.items()]
OTHERS = {
    "rig.yaml": read_everything,
    "ocam1.txt": read_cameras,
    "config.yaml": read_everything,
    "depth.png": lambda path: read_ground_truth(path, 0.55),
    "depth.tiff": lambda path: read_ground_truth(path, 0.55),
    "net.safetensors": load_weights,
    "net.ckpt": read_network,
}
IMAGES = {
    "a.png": (".png", (5, 7, 3)),
    "a.jpg": (".jpg", (5, 7, 3)),
    "a.tiff": (".tiff", (5, 7)),
    "a.bmp": (".bmp", (5, 7, 3)),
}
NAMES = [*(reader.name for reader in CALIBRATIONS), *OTHERS, *IMAGES]


def reader_of(name: str) -> Reader:
    if name in OTHERS:
        return Reader(name, written()[name], OTHERS[name])
    if name in IMAGES:
        suffix, size = IMAGES[name]
        return Reader(name, image(suffix, *size), by(read_image, read_mask))
    return next(reader for reader in CALIBRATIONS if reader.name == name)


@st.composite
def damaged(draw: st.DrawFn, content: bytes) -> bytes:
    """A file with some of its bytes replaced, repeated, moved or gone; at last perhaps cut off."""
    for _ in range(draw(st.integers(1, 4))):
        start = draw(st.integers(0, len(content)))
        end = min(len(content), start + draw(st.integers(0, 40)))
        kind = draw(st.sampled_from(["token", "token", "bytes", "delete", "repeat", "move"]))
        if kind == "token":
            middle = draw(st.sampled_from(TOKENS))
        elif kind == "bytes":
            middle = draw(st.binary(min_size=1, max_size=8))
        elif kind == "repeat":
            middle = content[start:end] * draw(st.integers(2, 50))
        elif kind == "move":
            place = draw(st.integers(0, len(content)))
            middle = content[place : place + 40]
        else:
            middle = b""
        content = content[:start] + middle + content[end:]
    return content[: draw(st.integers(0, len(content)))] if draw(st.booleans()) else content


@contextmanager
def in_time() -> Iterator[None]:
    """Fail instead of hanging."""

    def late(number: int, frame: Any) -> None:
        raise AssertionError(f"not read in {LONGEST} seconds")

    before = signal.signal(signal.SIGALRM, late)
    signal.setitimer(signal.ITIMER_REAL, LONGEST)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


def peak() -> int:
    """Bytes that this process has ever had in memory."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


@pytest.mark.parametrize("name", NAMES)
def test_every_damaged_file_is_read_or_refused(name: str, tmp_path: Path) -> None:
    reader = reader_of(name)
    path = tmp_path / name
    path.write_bytes(reader.content)
    reader.read(path)
    seen, longest = 0, [0]

    @settings(
        max_examples=EXAMPLES,
        deadline=None,
        database=None,
        phases=[Phase.generate, Phase.shrink],
        suppress_health_check=list(HealthCheck),
    )
    @given(content=damaged(reader.content))
    def read(content: bytes) -> None:
        nonlocal seen
        seen += 1
        path.write_bytes(content)
        with warnings.catch_warnings(), in_time():
            warnings.simplefilter("ignore")
            try:
                reader.read(path)
            except SphericalVisionError as error:
                longest.append(len(str(error)))

    before = peak()
    read()
    assert seen >= EXAMPLES
    assert peak() - before < MOST_MEMORY
    assert max(longest) < 3000


def test_samples_are_structured() -> None:
    """The damage begins with files that mean something."""
    for name, text in TEXTS.items():
        if name.endswith("json"):
            assert json.loads(text)
        elif name.endswith("yaml"):
            assert yaml.safe_load(text)
