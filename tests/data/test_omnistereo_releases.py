# SPDX-License-Identifier: Apache-2.0
"""Splits against the published numbers; frames by number of digits; scales."""

from contextlib import nullcontext
from pathlib import Path

import pytest

from sphericalvision.core import ArgumentError, FileFormatError, MissingFileError
from sphericalvision.data.omnistereo.releases import (
    RELEASES,
    check_scale,
    find_release,
    index_frames,
    read_min_depth,
    split_frames,
)


@pytest.mark.parametrize(
    ("dataset", "protocol", "split", "first", "last", "count"),
    [
        ("omnithings", "paper", "train", 1, 8240, 7216),
        ("omnithings", "paper", "val", 8241, 10240, 2000),
        ("omnihouse", "paper", "test", 1, 2048, 2048),
        ("omnithings", "official", "train", 1, 10240, 9216),
        ("omnithings", "official", "test", 4097, 5120, 1024),
        ("omnihouse", "official", "train", 1, 2048, 2048),
        ("omnihouse", "official", "test", 2049, 2560, 512),
        ("sunny", "official", "train", 1, 700, 700),
        ("cloudy", "official", "test", 701, 1000, 300),
        ("sunset", "official", "test", 701, 1000, 300),
        ("omnithings", "paper", "all", 1, 10240, 10240),
    ],
)
def test_convention_splits(
    dataset: str, protocol: str, split: str, first: int, last: int, count: int
) -> None:
    frames = split_frames(dataset, split, protocol)
    assert (frames[0], frames[-1], len(frames)) == (first, last, count)
    assert len(set(frames)) == count


@pytest.mark.parametrize("protocol", ["paper", "official"])
def test_training_frames_are_in_no_other_split(protocol: str) -> None:
    train = set(split_frames("omnithings", "train", protocol))
    held_out = set(split_frames("omnithings", "val" if protocol == "paper" else "test", protocol))
    assert not train & held_out


def test_frames_are_found_by_number_whatever_the_digits(tmp_path: Path) -> None:
    for name in ("00001.png", "0001.png", "0002.png", "10240.png", "thumbs.png", "3.txt", ".0007.png"):
        (tmp_path / name).touch()
    files = index_frames(tmp_path, "images")
    assert {number: file.name for number, file in files.items()} == {
        1: "00001.png",
        2: "0002.png",
        10240: "10240.png",
    }
    with pytest.raises(MissingFileError, match=r"no such folder .images of cam2 expected"):
        index_frames(tmp_path / "cam2", "images of cam2")


def layout(root: Path, *names: str) -> Path:
    for name in names:
        if "." in name:
            (root / name).touch()
        else:
            (root / name).mkdir()
    return root


def test_each_release_is_told_by_ground_truth_and_calibration(tmp_path: Path) -> None:
    assert find_release(layout(tmp_path, "depth_train_640", "poses.txt")) is RELEASES["png"]
    (tmp_path / "omnidepth_gt_640").mkdir()  # an incomplete second release does not disturb
    assert find_release(tmp_path) is RELEASES["png"]
    layout(tmp_path, "config.yaml")
    with pytest.raises(ArgumentError, match="both releases"):
        find_release(tmp_path)
    assert find_release(tmp_path, "tiff") is RELEASES["tiff"]
    for names, found in (
        (("depth_train_640", "config.yaml"), "PNG ground truth in depth_train_640/ with config.yaml"),
        (("omnidepth_gt_640", "poses.txt"), "TIFF ground truth in omnidepth_gt_640/ with poses.txt"),
    ):
        (tmp_path / names[0] / "mixed").mkdir()
        with pytest.raises(FileFormatError, match=f"mixed releases: found {found}"):
            find_release(layout(tmp_path / names[0] / "mixed", *names))
    with pytest.raises(MissingFileError, match=r"nowhere.*poses\.txt.*http"):
        find_release(tmp_path / "nowhere")
    (tmp_path / "empty").mkdir()
    with pytest.raises(MissingFileError, match="incomplete data set"):
        find_release(tmp_path / "empty")


@pytest.mark.parametrize(
    ("min_depth", "radius", "fits"),
    [
        *((0.55, 0.20, True), (1.65, 0.60, True), (0.5, 0.21, True), (0.55, 0.04, True), (3.0, 0.6, True)),
        *((1.31, 0.20, True), (1.33, 0.20, False), (1.65, 0.159, True), (1.65, 0.161, False)),
        *((1.65, 0.249, False), (1.65, 0.251, True), (0.2, 0.2, True), (0.19, 0.2, False)),
    ],
)
def test_the_scales_of_two_releases_are_not_mixed(
    tmp_path: Path, min_depth: float, radius: float, fits: bool
) -> None:
    for release in RELEASES.values():
        with nullcontext() if fits else pytest.raises(FileFormatError):
            check_scale(tmp_path, release, min_depth, radius)


def test_minimum_depth_is_read_or_none(tmp_path: Path) -> None:
    config = tmp_path / "config.yaml"
    config.write_text("config: {omnimvs_sweep_min_depth: 1.65}")
    assert read_min_depth(config) == 1.65
    config.write_text("cameras: []")
    assert read_min_depth(config) is None
    for text in ("{omnimvs_sweep_min_depth: near}", "{omnimvs_sweep_min_depth: -1}", "["):
        config.write_text(f"config: {text}")
        with pytest.raises(FileFormatError, match=r"config\.yaml: .*(a positive number|not valid YAML)"):
            read_min_depth(config)
