# SPDX-License-Identifier: Apache-2.0
"""Orientations of a rig's cameras from its own images: ``sphericalvision-align calibration=rig.yaml images=…``.

What it does is in ``recipes/commands/align.py``, imported once the command line has been read.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from sphericalvision.recipes.app.command import command

if TYPE_CHECKING:
    from omegaconf import DictConfig

__all__ = ["main"]


@command("align")
def main(config: DictConfig) -> Any:
    """Command line of alignment."""
    from sphericalvision.recipes.commands.align import align

    return align(config)


if __name__ == "__main__":
    main()
