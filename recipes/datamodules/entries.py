# SPDX-License-Identifier: Apache-2.0
"""The entries of samples: which a network wants, and how it gets them from a batch."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any, NamedTuple

from annotated_types import MinLen
from torch import Tensor

from sphericalvision.core import ArgumentError, check_choice
from sphericalvision.data import ToSphere
from sphericalvision.models import DepthNetwork
from sphericalvision.scenes.world import NATURAL_MIN_DEPTH
from sphericalvision.sphere.intake import Intake

__all__ = [
    "ENTRIES",
    "ChosenEntries",
    "Entries",
    "Wanted",
    "check_on_icospheres",
    "images_of",
    "truth_of",
]

ENTRIES = ("sphere", "fisheye", "panorama")

Sample = dict[str, Any]

Entries = Annotated[Sequence[str], MinLen(1)] | None
"""What samples are asked to hold, in place of what the network wants."""


class Wanted(NamedTuple):
    """What samples must be like for a network.

    Attributes:
        entries: that it is trained with, as ``data.entries`` names them.
        level: icosphere level of the images of "sphere".
        depth_level: icosphere level of the depth at vertices.
        panorama_size: (height, width) of depth panoramas.
        min_depth: nearest hypothesis in metres.
    """

    entries: tuple[str, ...] = ("sphere",)
    level: int = 5
    depth_level: int = 3
    panorama_size: tuple[int, int] | None = None
    min_depth: float = NATURAL_MIN_DEPTH

    @classmethod
    def by(cls, net: DepthNetwork, depth_level: int | None = None) -> Wanted:
        """What a network wants, by its ``images`` and ``grid``; depth at vertices may be wanted at another level."""
        sphere = net.images == "sphere"
        entries: tuple[str, ...] = ("sphere",) if sphere else ("fisheye",)
        size, usual = None, net.depth_level
        if usual is None:
            grid: Any = net.grid
            height, width = grid.shape
            size = (height if grid.max_latitude > 1.5 else width // 4, width)
            entries, usual = (*entries, "panorama"), (net.level if sphere else 5) - 2
        elif not sphere:
            entries = (*entries, "depth")
        chosen = usual if depth_level is None else depth_level
        return cls(entries, net.level if sphere else chosen + 2, chosen, size, net.min_depth)


def check_on_icospheres(net: DepthNetwork, samples: str) -> None:
    """Refuse a network that takes or gives anything that is not on an icosphere."""
    if net.images != "sphere" or net.depth_level is None:
        raise ArgumentError(f"data: {samples} are for networks on icospheres, not {type(net).__name__}")


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
    grid: Any = net.grid
    if net.depth_level is None:
        whole = (_entry(batch, f"panorama_{name}", net) for name in ("inverse_depth", "valid"))
        inverse_depth, valid = (grid.rows_of(values) for values in whole)
        return inverse_depth, valid
    inverse_depth, valid = _entry(batch, "inverse_depth", net), _entry(batch, "valid", net)
    if inverse_depth.shape[-1:] != net.grid.shape:
        raise ArgumentError(
            f"data: samples have depth at {inverse_depth.shape[-1]} vertices, {type(net).__name__} estimates it "
            f"at {net.grid.shape[0]} (level {net.grid.level}); take data of that level"
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
        self.entries = tuple("sphere" if entry == "depth" else entry for entry in entries)
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
