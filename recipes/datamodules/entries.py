# SPDX-License-Identifier: Apache-2.0
"""The entries of samples: which a network wants, and how it gets them from a batch."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from torch import Tensor

from sphericalvision.core import ArgumentError, check_choice
from sphericalvision.data import ToSphere
from sphericalvision.icosphere import Icosphere
from sphericalvision.models import DepthNetwork
from sphericalvision.sphere.intake import Intake

__all__ = ["ENTRIES", "ChosenEntries", "Wanted", "images_of", "truth_of"]

ENTRIES = ("sphere", "fisheye", "panorama")

Sample = dict[str, Any]


class Wanted(NamedTuple):
    """What samples must be like for a network.

    Attributes:
        entries: that it is trained with, as ``data.entries`` names them.
        level: icosphere level of the images of "sphere".
        depth_level: icosphere level of the depth at vertices.
        panorama_size: (height, width) of depth panoramas.
        min_depth: nearest hypothesis in metres.
    """

    entries: tuple[str, ...]
    level: int
    depth_level: int
    panorama_size: tuple[int, int] | None
    min_depth: float

    @classmethod
    def by(cls, net: DepthNetwork) -> Wanted:
        """What a network wants, by its ``images`` and ``grid``."""
        images = ("sphere",) if net.images == "sphere" else ("fisheye",)
        if isinstance(net.grid, Icosphere):
            truth = () if net.images == "sphere" else ("depth",)
            level = net.level if net.images == "sphere" else net.grid.level + 2
            return cls((*images, *truth), level, net.grid.level, None, net.min_depth)
        level = net.level if net.images == "sphere" else 5
        height, width = net.grid.shape
        whole = height if net.grid.max_latitude > 1.5 else width // 4
        return cls((*images, "panorama"), level, level - 2, (whole, width), net.min_depth)

    def scale(self, given: Mapping[str, Any], depth_level: int | None = None) -> dict[str, Any]:
        """``level``, ``depth_level`` and ``min_depth`` as given, or else the network's.

        A level that is given brings depth two levels below, as always, unless that is given, too.

        Raises:
            ArgumentError: images or, where ``depth_level`` is not given, depth are wanted on another icosphere than the
                network's. It is said here, before anything is rendered.
        """
        if (
            "sphere" in self.entries
            and "depth" not in self.entries
            and given["level"] not in (None, self.level)
        ):
            raise ArgumentError(
                f"data.level: the network takes images of level {self.level}, got {given['level']}; set "
                f"model.level={given['level']} or leave data.level out"
            )
        mine = {"level": self.level, "depth_level": self.depth_level, "min_depth": self.min_depth}
        chosen = {key: mine[key] if given[key] is None else given[key] for key in mine}
        if given["depth_level"] is None and depth_level is not None:
            chosen["depth_level"] = depth_level
        elif given["depth_level"] is None and given["level"] is not None:
            chosen["depth_level"] = given["level"] - 2
        if self.panorama_size is None and depth_level is None and chosen["depth_level"] != self.depth_level:
            raise ArgumentError(
                f"data.depth_level: the network estimates depth at level {self.depth_level}, got "
                f"{chosen['depth_level']}; leave data.level and data.depth_level out"
            )
        return chosen


def images_of(batch: Sample, net: DepthNetwork) -> tuple[Tensor, Tensor | None]:
    """The images of a batch that a network takes, and what of them was seen (None where samples do not tell).

    Raises:
        ArgumentError: these samples do not hold them.
    """
    key, seen = ("images", "seen") if net.images == "sphere" else ("fisheye", "fisheye_seen")
    return _entry(batch, key, net), batch.get(seen)


def truth_of(batch: Sample, net: DepthNetwork) -> tuple[Tensor, Tensor]:
    """Inverse depth in 1/m of a batch on the grid of a network, and where it is known, both ``(B, *grid)``.

    Raises:
        ArgumentError: these samples do not hold it, or only on another icosphere.
    """
    if not isinstance(net.grid, Icosphere):
        whole = (_entry(batch, f"panorama_{name}", net) for name in ("inverse_depth", "valid"))
        inverse_depth, valid = (net.grid.rows_of(values) for values in whole)
        return inverse_depth, valid
    inverse_depth, valid = _entry(batch, "inverse_depth", net), _entry(batch, "valid", net)
    if inverse_depth.shape[-1:] != net.grid.shape:
        raise ArgumentError(
            f"data.level: samples have depth at {inverse_depth.shape[-1]} vertices, {type(net).__name__} estimates it "
            f"at {net.grid.shape[0]} (level {net.grid.level}); set data.depth_level={net.grid.level}"
        )
    return inverse_depth, valid


def _entry(batch: Sample, key: str, net: DepthNetwork) -> Any:
    if key in batch:
        return batch[key]
    raise ArgumentError(
        f"data: {type(net).__name__} wants the entry '{key}', samples hold {', '.join(batch)}; leave out data.entries, "
        "or take other data"
    )


class ChosenEntries:
    """The last transform of a sample: what networks on the icosphere and on panoramas want of it.

    Args:
        entries: some of "sphere", "fisheye" and "panorama".
        level: icosphere level of the images of "sphere".
        depth_level: icosphere level of its depth; two below ``level`` when not given.

    Returns:
        The sample with ``images``, ``seen``, ``inverse_depth`` and ``valid`` of ``ToSphere`` for "sphere"; ``fisheye``
        ``(n, 3, H, W)`` in [-1, 1], 0 where not ``fisheye_seen`` ``(n, H, W)``; ``panorama_inverse_depth`` and
        ``panorama_valid`` ``(h, w)`` for "panorama". Entries not asked for are gone.

    Raises:
        ArgumentError: an unknown entry or none; images that differ in size for "fisheye".
    """

    def __init__(self, entries: Sequence[str], level: int, depth_level: int | None = None) -> None:
        self.entries = tuple(entries)
        if not self.entries:
            raise ArgumentError(f"data.entries: expected some of {', '.join(map(repr, ENTRIES))}, got none")
        for entry in self.entries:
            check_choice("data.entries", entry, ENTRIES)
        self.to_sphere = ToSphere(level, depth_level) if "sphere" in self.entries else None
        self._intake: Intake | None = None

    def __call__(self, sample: Sample) -> Sample:
        chosen = {
            key: value
            for key, value in sample.items()
            if key not in ("images", "seen", "inverse_depth", "valid")
        }
        if self.to_sphere is not None:
            chosen = self.to_sphere(sample)
        if "fisheye" in self.entries:
            rig = sample["rig"]
            if self._intake is None or self._intake.rig is not rig:
                self._intake = Intake(rig, None)
            chosen |= {"fisheye": self._intake(sample["images"]), "fisheye_seen": self._intake.seen}
        if "panorama" in self.entries:
            chosen |= {"panorama_inverse_depth": sample["inverse_depth"], "panorama_valid": sample["valid"]}
        return chosen
