# SPDX-License-Identifier: Apache-2.0
"""Files appear whole or not at all: interrupted, on a full disk, beside readers, and with usual permissions."""

import os
import resource
import stat
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file

from sphericalvision.cameras import read_camera
from sphericalvision.core import FileFormatError, MissingFileError, check_file
from sphericalvision.io.files import (
    atomic_write,
    by_numbers,
    part_of_name,
    read_text,
    write_bytes,
)
from sphericalvision.io.images import read_image, write_image, write_mask, write_pages
from sphericalvision.io.yaml_files import write_yaml


def test_an_interrupted_write_leaves_the_old_file_and_nothing_else(tmp_path: Path) -> None:
    target = tmp_path / "a.txt"
    target.write_text("old")

    def interrupted() -> None:
        with atomic_write(target) as temporary:
            temporary.write_text("half of the n")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert target.read_text() == "old"
    assert [file.name for file in tmp_path.iterdir()] == ["a.txt"]


def test_what_a_killed_process_left_is_swept(tmp_path: Path) -> None:
    program = (
        "import os, sys; from pathlib import Path; from sphericalvision.io.files import atomic_write\n"
        "with atomic_write(Path(sys.argv[1]) / 'a.txt') as temporary: sys.argv[2:] or os.kill(os.getpid(), 9)"
    )
    command = [sys.executable, "-c", program, str(tmp_path)]
    subprocess.run(command, check=False)
    (left,) = tmp_path.iterdir()
    others = {tmp_path / ".hidden.txt", tmp_path / f".{'0' * 8}{left.name[9:]}"}
    for file in others:  # of somebody else, and of another machine
        file.write_text("here")
    with atomic_write(tmp_path / "b.txt") as living:
        assert not left.exists()
        subprocess.run([*command, "to the end"], check=True)
        assert living.exists()
    assert {*tmp_path.iterdir()} == {*others, tmp_path / "a.txt", tmp_path / "b.txt"}


def test_files_are_in_the_order_of_their_numbers() -> None:
    """A superscript is a digit, and no number."""
    names = [
        "a/calib_1.txt",
        "a/calib_02.txt",
        "a/calib_2.txt",
        "a/calib_10.txt",
        f"a/calib_{'9' * 5000}.txt",
        "b/calib_1.txt",
        "²1.txt",
    ]
    assert [str(path) for path in sorted(map(Path, reversed(names)), key=by_numbers)] == names


def test_until_the_end_readers_find_the_old_file(tmp_path: Path) -> None:
    target = tmp_path / "new" / "folder" / ("long" * 60 + ".txt")
    write_bytes(target, b"old")
    with atomic_write(target) as temporary:
        assert temporary.suffix == ".txt"
        assert temporary.parent == target.parent
        temporary.write_bytes(b"new")
        assert target.read_bytes() == b"old"
    assert target.read_bytes() == b"new"
    assert list(target.parent.iterdir()) == [target]


@pytest.mark.parametrize("umask", [0o022, 0o027, 0o077])
def test_permissions_are_those_of_any_new_file(umask: int, tmp_path: Path) -> None:
    """Also where a writer puts a private file of its own in place, as some do."""

    def weights(path: Path) -> None:
        with atomic_write(path) as temporary:
            save_file({"a": torch.zeros(2)}, temporary)

    def private(path: Path) -> None:
        with atomic_write(path) as temporary:
            temporary.unlink()
            os.close(os.open(temporary, os.O_CREAT | os.O_WRONLY, 0o600))

    before = os.umask(umask)
    try:
        (tmp_path / "usual").write_text("")
        expected = stat.S_IMODE((tmp_path / "usual").stat().st_mode)
        for number, write in enumerate((weights, private, lambda path: write_bytes(path, b"text"))):
            path = tmp_path / f"{number}.safetensors"
            write(path)
            assert stat.S_IMODE(path.stat().st_mode) == expected
    finally:
        os.umask(before)


@contextmanager
def files_up_to(size: int) -> Iterator[None]:
    """The system refuses every byte of a file beyond ``size``, as a full disk does."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


NOISE = torch.rand(3, 64, 64, generator=torch.Generator().manual_seed(0))
WRITERS: dict[str, Callable[[Path], None]] = {
    "image.png": lambda path: write_image(path, NOISE),
    "image.jpg": lambda path: write_image(path, NOISE),
    "pages.tiff": lambda path: write_pages(path, [NOISE[0].numpy(), NOISE[1].numpy()]),
    "mask.png": lambda path: write_mask(path, NOISE[0] > 0.5),
    "text.yaml": lambda path: write_yaml(path, {"numbers": NOISE.flatten().tolist()}),
}


@pytest.mark.parametrize("name", WRITERS)
def test_a_full_disk_is_an_error_and_leaves_what_was_there(name: str, tmp_path: Path) -> None:
    path = tmp_path / name
    with files_up_to(100), pytest.raises(OSError, match="File too large"):
        WRITERS[name](path)
    assert list(tmp_path.iterdir()) == []
    WRITERS[name](path)
    whole = path.read_bytes()
    with files_up_to(len(whole) - 1), pytest.raises(OSError, match="File too large"):
        WRITERS[name](path)
    assert path.read_bytes() == whole
    assert list(tmp_path.iterdir()) == [path]


def test_a_part_written_without_a_complaint_is_an_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def half(path: Path, content: bytes) -> int:
        with path.open("wb") as file:
            return file.write(content[: len(content) // 2])

    monkeypatch.setattr(Path, "write_bytes", half)
    with pytest.raises(OSError, match=r"3 of 6 bytes were written.*a\.txt"):
        write_bytes(tmp_path / "a.txt", b"abcdef")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "name", ["../../x", "/tmp/x", "a/../../b", "x" * 300, "\0", ".", "..", "a b", "\ud800", ""]
)
def test_names_from_elsewhere_lead_nowhere(name: str, tmp_path: Path) -> None:
    file = tmp_path / "inside" / f"mask_{part_of_name(name)}.png"
    write_bytes(file, b"x")
    assert [path.relative_to(tmp_path).parts[0] for path in tmp_path.rglob("*.png")] == ["inside"]
    assert file.parent == tmp_path / "inside"
    folder = tmp_path / "inside" / part_of_name(name)
    assert folder.resolve().parent == tmp_path / "inside"


@pytest.mark.parametrize("read", [read_text, read_image, read_camera])
def test_a_file_that_claims_to_be_larger_than_machines_is_refused(
    tmp_path: Path, read: Callable[[Path], object]
) -> None:
    with (tmp_path / "cameras.bin").open("wb") as file:
        file.truncate(2**40)  # which takes no space
    with pytest.raises(FileFormatError, match=r"cameras\.bin: has 1,099,511,627,776 bytes"):
        read(tmp_path / "cameras.bin")


def test_what_may_never_end_is_refused(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path / "pipe", Path("/dev/zero")):
        with pytest.raises(FileFormatError, match=f"{path}: expected a file"):
            read_text(path)


def test_plain_names_stay_and_others_stay_apart() -> None:
    assert part_of_name("cam-1_left.x") == "cam-1_left.x"
    assert part_of_name("a/b") != part_of_name("a_b") != part_of_name("a b")


@pytest.mark.parametrize("name", ["x" * 5000, "nul" + chr(0)])
def test_names_that_no_file_can_have_are_missing_files(name: str, tmp_path: Path) -> None:
    with pytest.raises(MissingFileError, match="a rig expected") as told:
        check_file(tmp_path / name, "a rig")
    assert len(str(told.value)) <= 2000
