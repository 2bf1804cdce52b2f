# SPDX-License-Identifier: Apache-2.0
"""Data modules whose samples have depth, as a network takes them."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Annotated, Any, Literal

from annotated_types import MinLen

from sphericalvision.data import SampleView
from sphericalvision.recipes.datamodules.data_module import SampleDataModule
from sphericalvision.scenes.world import NATURAL_MIN_DEPTH

Entry = Literal["sphere", "depth", "fisheye", "panorama"]
Entries = Annotated[Sequence[Entry], MinLen(1)] | None
"""Contents of samples, in place of what the network takes: images and depth on the icosphere, depth there alone, images
of the cameras, a panorama of depth."""


def view_with(entries: Sequence[str], view: SampleView) -> SampleView:
    """The parts of a view that entries name."""
    return replace(
        view,
        level=view.level if "sphere" in entries else None,
        depth_level=view.depth_level if {"sphere", "depth"} & set(entries) else None,
        images="fisheye" in entries,
        panorama=view.panorama if "panorama" in entries else None,
    )


class DepthDataModule(SampleDataModule):
    """Samples with depth, as the network takes them that they are for; a field ``entries`` may ask for others."""

    entries: Entries = None

    @property
    def usual_panorama(self) -> tuple[int, int]:
        """(height, width) of panoramas of depth for networks that are not on panoramas."""
        return 80, 160

    def __post_init__(self) -> None:
        self.min_depth = NATURAL_MIN_DEPTH
        self.view = view_with(self.entries or ("sphere",), SampleView(5, 3, True, self.usual_panorama))

    def bind_network(self, net: Any, *more: str, depth_level: int | None = None) -> None:
        """Give samples that suit a network, with ``more`` entries; entries that the configuration names stay."""
        on_sphere, own_level, panorama = net.images == "sphere", net.depth_level, self.usual_panorama
        usual = ["sphere"] if on_sphere else ["fisheye"]
        if own_level is None:  # depth is on a panorama: of the whole sphere, or of a belt around the horizon
            height, width = net.grid.shape
            panorama = (height if net.grid.max_latitude > 1.5 else width // 4, width)
            own_level = (net.level if on_sphere else 5) - 2
            usual.append("panorama")
        elif not on_sphere:
            usual.append("depth")
        depth_level = own_level if depth_level is None else depth_level
        level = net.image_level if on_sphere else depth_level + 2
        self.min_depth = net.min_depth
        self.view = view_with(self.entries or (*usual, *more), SampleView(level, depth_level, True, panorama))
