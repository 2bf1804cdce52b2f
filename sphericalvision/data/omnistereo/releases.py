# SPDX-License-Identifier: Apache-2.0
"""Facts about the omnidirectional stereo sets: frames, splits, the two releases and where their files lie."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path, PurePath

from sphericalvision.cameras.calibration.text_files import load
from sphericalvision.core import (
    ArgumentError,
    FileFormatError,
    MissingFileError,
    check_choice,
    check_file,
    short_repr,
)
from sphericalvision.io.files import list_folder

DESCRIBED_AT = "the docstring of sphericalvision.data.OmniStereoDataset and http://cvlab.hanyang.ac.kr/project/omnistereo"

Frames = tuple[range, ...]

_FRAMES: dict[str, Frames] = {
    "omnithings": (range(1, 10241),),
    "omnihouse": (range(1, 2561),),
    "sunny": (range(1, 1001),),
    "cloudy": (range(1, 1001),),
    "sunset": (range(1, 1001),),
}
_URBAN: dict[str, Frames] = {"train": (range(1, 701),), "test": (range(701, 1001),)}
_SPLITS: dict[str, dict[str, dict[str, Frames]]] = {
    "official": {
        "omnithings": {"train": (range(1, 4097), range(5121, 10241)), "test": (range(4097, 5121),)},
        "omnihouse": {"train": (range(1, 2049),), "test": (range(2049, 2561),)},
        "sunny": _URBAN,
        "cloudy": _URBAN,
        "sunset": _URBAN,
    },
    "paper": {
        "omnithings": {"train": (range(1, 4097), range(5121, 8241)), "val": (range(8241, 10241),)},
        "omnihouse": {"test": (range(1, 2049),)},
    },
}
PROTOCOLS = tuple(_SPLITS)


def split_frames(dataset: str, split: str, protocol: str = "paper") -> list[int]:
    """Frame numbers of one split, ascending.

    Args:
        dataset: "omnithings", "omnihouse", "sunny", "cloudy" or "sunset".
        split: "train", "val" or "test", as far as the protocol has it, or "all" frames of the set.
        protocol: "paper" (IcoSweepNet: trained on OmniThings, tested on OmniHouse) or "official".

    Raises:
        ArgumentError: an unknown name, or a split that the protocol does not have.

    References:
        Komatsu et al., 360 Depth Estimation from Multiple Fisheye Images with Origami Crown Representation of
        Icosahedron, IROS 2020, section V. Won et al., OmniMVS, ICCV 2019, section 5.

    Examples:
        >>> len(split_frames("omnithings", "train")), len(split_frames("omnithings", "val"))
        (7216, 2000)
        >>> frames = split_frames("sunny", "test", protocol="official")
        >>> frames[0], frames[-1]
        (701, 1000)
    """
    check_choice("dataset", dataset, tuple(_FRAMES))
    check_choice("protocol", protocol, PROTOCOLS)
    splits = {"all": _FRAMES[dataset], **_SPLITS[protocol].get(dataset, {})}
    if split not in splits:
        raise ArgumentError(
            f"split: {dataset} has {', '.join(map(repr, splits))} in the {protocol!r} protocol, got "
            f"{split!r}. Choose one of these, another protocol ({', '.join(PROTOCOLS)}), or give frame "
            f"numbers as frames=..."
        )
    return list(chain.from_iterable(splits[split]))


@dataclass(frozen=True)
class Release:
    """One of the two consistent combinations of ground truth, calibration and scale."""

    name: str
    ground_truth_folder: str
    suffix: str
    calibration: str
    min_depth: float
    """Metres, of the published data."""
    radius: float
    """Metres from the rig's centre to its cameras, of the published data."""

    def __str__(self) -> str:
        return f"{self.name.upper()} ground truth in {self.ground_truth_folder}/ with {self.calibration}"


RELEASES = {
    "png": Release("png", "depth_train_640", ".png", "poses.txt", 0.55, 0.20),
    "tiff": Release("tiff", "omnidepth_gt_640", ".tiff", "config.yaml", 1.65, 0.60),
}


def find_release(root: str | Path, name: str | None = None) -> Release:
    """Return the release in a folder, recognised by its ground-truth folder and its calibration file.

    Raises:
        MissingFileError: no such folder, or it holds neither release; the message lists what is expected.
        FileFormatError: ground truth of one release with the calibration of the other.
        ArgumentError: both releases are there and ``name`` is None.
    """
    root = Path(root)
    if name is not None:
        check_choice("release", name, tuple(RELEASES))
    if not root.is_dir():
        raise MissingFileError(f"root: {root.absolute()} is not a folder. {_expectation()}")
    truths = [release for release in RELEASES.values() if (root / release.ground_truth_folder).is_dir()]
    calibrations = [release for release in RELEASES.values() if (root / release.calibration).is_file()]
    complete = [release for release in truths if release in calibrations]
    matches = [release for release in complete if name in (None, release.name)]
    if len(matches) == 1:
        return matches[0]
    if len(matches) > 1:
        raise ArgumentError(
            f"release: {root} holds both releases, which differ in scale; choose release='png' or 'tiff'"
        )
    candidates = [release for release in truths if name in (None, release.name)]
    if candidates and calibrations:
        raise FileFormatError(
            f"{root}: mixed releases: found {candidates[0].name.upper()} ground truth in "
            f"{candidates[0].ground_truth_folder}/ with {calibrations[0].calibration}. {_valid_triples()}"
        )
    raise MissingFileError(f"{root.absolute()}: incomplete data set. {_expectation(name)}")


def check_scale(root: str | Path, release: Release, min_depth: float, radius: float) -> None:
    """Refuse the mixtures of the two published scales: depth of the one with the rig of the other.

    In both releases the minimum depth is 2.75 times the rig's radius; mixed, it is 0.92 or 8.25 times. A
    minimum depth below the radius is refused for any rig, since the nearest sphere of a sweep would leave the
    cameras outside. The factor 8.25 is refused at the published size only: small rigs may well look so far.
    """
    small, large = RELEASES["png"], RELEASES["tiff"]
    far_for_small = min_depth / large.min_depth > 0.8 and 0.8 < radius / small.radius < 1.25
    if min_depth < radius or far_for_small:
        raise FileFormatError(
            f"{root}: the scales do not belong together: found {release.name.upper()} ground truth with "
            f"{release.calibration}, minimum depth {min_depth:g} m, rig radius {radius:.3g} m "
            f"(ratio {min_depth / max(radius, 1e-9):.2f}). {_valid_triples()} "
            f"Check the unit of the poses and min_depth."
        )


def read_min_depth(config: str | Path) -> float | None:
    """Minimum depth in metres from a config.yaml, None if it has none."""
    config = check_file(config, "calibration and minimum depth")
    content = load(config)
    section = content.get("config") if isinstance(content, dict) else None
    if not isinstance(section, dict) or section.get("omnimvs_sweep_min_depth") is None:
        return None
    value = section["omnimvs_sweep_min_depth"]
    if not isinstance(value, int | float) or not 0 < value < float("inf"):
        raise FileFormatError(
            f"{config}: config.omnimvs_sweep_min_depth: expected a positive number of metres, got {short_repr(value)}"
        )
    return float(value)


def index_frames(
    folder: str | Path, what: str, suffixes: Sequence[str] = (".png", ".jpg", ".jpeg")
) -> dict[int, Path]:
    """Map frame numbers to files, whatever the number of digits; five digits win where both exist.

    OmniThings needs this: its first folder numbers with five digits, the other three with four.
    """
    names = list_folder(folder, what)
    numbered = [
        name for name in names if PurePath(name).stem.isdecimal() and PurePath(name).suffix in suffixes
    ]
    numbered.sort(key=lambda name: (len(PurePath(name).stem) == 5, name))
    return {int(PurePath(name).stem): Path(folder) / name for name in numbered}


def _valid_triples() -> str:
    releases = "; ".join(
        f"({release}, minimum depth {release.min_depth:g} m, rig radius {release.radius:.2f} m)"
        for release in RELEASES.values()
    )
    return f"The two published releases differ threefold in scale and are valid only whole: {releases}."


def _expectation(name: str | None = None) -> str:
    releases = [release for release in RELEASES.values() if name in (None, release.name)]
    files = {"png": "ocam1.txt .. ocam4.txt, poses.txt", "tiff": "config.yaml"}
    layouts = " or ".join(
        f"{files[release.name]} and {release.ground_truth_folder}/00001{release.suffix}"
        for release in releases
    )
    images = "cam1/ .. cam4/ with 00001.png or 0001.png each"
    return f"Expected there: {images}, and {layouts}. Described in {DESCRIBED_AT}."
