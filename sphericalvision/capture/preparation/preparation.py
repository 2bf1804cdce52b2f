# SPDX-License-Identifier: Apache-2.0
"""``Preparation``: how a capture is made ready before depth is estimated, as one value."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from typing import Any

from jaxtyping import Float
from torch import Tensor

from sphericalvision.cameras import CameraRig
from sphericalvision.capture.preparation.compensation import compensated
from sphericalvision.core import ArgumentError

__all__ = ["AS_IT_IS", "AUTO", "Preparation"]

AUTO = "auto"
"""In place of a pattern of masks: those of the rig's own body, found in the frames."""


@dataclass(frozen=True)
class Preparation:
    """How a capture is made ready before depth is estimated.

    Attributes:
        photometric: whether noise of more than 1 % is smoothed, and differences in exposure and vignetting between the
            cameras are compensated if they exceed 5 %. All are estimated from each frame (``calibrate_photometry``).
        align: whether cameras that a few frames show to be turned are turned back (``Predictor.prepare``).
        own_body: whether what stands still in all frames, the body that carries the rig, is masked (``find_own_body``).

    Raises:
        ArgumentError: a value is not True or False.

    Examples:
        >>> Preparation.from_keys({"photometric": False, "masks": "auto", "output": "out"})
        Preparation(photometric=False, align=True, own_body=True)
    """

    photometric: bool = True
    align: bool = True
    own_body: bool = False

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if not isinstance(value, bool):
                raise ArgumentError(f"{field.name}: expected true or false, got {value!r}")

    @classmethod
    def from_keys(cls, config: Mapping[str, Any]) -> Preparation:
        """Return what the keys of a command say: those of the attributes' names, and ``masks=auto``."""
        switches = {name: config[name] for name in ("photometric", "align") if name in config}
        return cls(**switches, own_body=config.get("masks") == AUTO)

    @property
    def of_images(self) -> Callable[[CameraRig, Mapping[str, Tensor]], dict[str, Tensor]] | None:
        """The function of a rig and the images of a frame that makes these ready; None where nothing is done."""
        return compensated if self.photometric else None

    def images(
        self, rig: CameraRig, images: Mapping[str, Float[Tensor, "*batch c _ _"]]
    ) -> dict[str, Float[Tensor, "*batch c _ _"]]:
        """Return the images of a frame, camera name -> ``(*b, c, h, w)`` in [0, 1], made ready."""
        return dict(images) if self.of_images is None else self.of_images(rig, images)


AS_IT_IS = Preparation(photometric=False, align=False)
