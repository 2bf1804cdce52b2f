# SPDX-License-Identifier: Apache-2.0
"""The entries of a sample that networks on the icosphere and on panoramas want."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from sphericalvision.cameras import CameraRig
from sphericalvision.core import ArgumentError, check_choice
from sphericalvision.data import ToSphere
from sphericalvision.data.seen import pixels_seen

__all__ = ["ENTRIES", "ChosenEntries"]

ENTRIES = ("sphere", "fisheye", "panorama")

Sample = dict[str, Any]


class ChosenEntries:
    """The last transform of a sample: what networks on the icosphere and on panoramas want of it.

    Args:
        entries: some of "sphere", "fisheye" and "panorama".
        level: icosphere level of the images of "sphere".

    Returns:
        The sample with ``images``, ``seen``, ``inverse_depth`` and ``valid`` of ``ToSphere`` for "sphere"; ``fisheye``
        ``(n, 3, H, W)`` in [-1, 1], 0 where not ``fisheye_seen`` ``(n, H, W)``; ``panorama_inverse_depth`` and
        ``panorama_valid`` ``(h, w)`` for "panorama". Entries not asked for are gone.

    Raises:
        ArgumentError: an unknown entry or none; images that differ in size for "fisheye".
    """

    def __init__(self, entries: Sequence[str], level: int) -> None:
        self.entries = tuple(entries)
        if not self.entries:
            raise ArgumentError(f"data.entries: expected some of {', '.join(map(repr, ENTRIES))}, got none")
        for entry in self.entries:
            check_choice("data.entries", entry, ENTRIES)
        self.to_sphere = ToSphere(level) if "sphere" in self.entries else None
        self._rig: CameraRig | None = None
        self._seen = torch.empty(0)

    def __call__(self, sample: Sample) -> Sample:
        chosen = {
            key: value
            for key, value in sample.items()
            if key not in ("images", "seen", "inverse_depth", "valid")
        }
        if self.to_sphere is not None:
            chosen = self.to_sphere(sample)
        if "fisheye" in self.entries:
            chosen["fisheye"] = self._stacked(sample["images"], sample["rig"])
            chosen["fisheye_seen"] = self._seen
        if "panorama" in self.entries:
            chosen |= {"panorama_inverse_depth": sample["inverse_depth"], "panorama_valid": sample["valid"]}
        return chosen

    def _stacked(self, images: dict[str, Tensor], rig: CameraRig) -> Tensor:
        sizes = sorted({tuple(image.shape[-2:]) for image in images.values()})
        if len(sizes) > 1:
            raise ArgumentError(f"data: images of one size are wanted for the entry 'fisheye', got {sizes}")
        if self._rig is not rig:
            self._rig, self._seen = rig, torch.stack(list(pixels_seen(rig).values()))
        return (torch.stack([images[name] for name in rig.names]) * 2 - 1) * self._seen[:, None]
