# SPDX-License-Identifier: Apache-2.0
"""A camera from pictures of a checkerboard: ``sphericalvision-calibrate images='board/*.png' board=9x6 square=0.03``.

What it does is in ``recipes/commands/calibrate.py``, imported once the command line has been read.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from sphericalvision.recipes.app.command import command

if TYPE_CHECKING:
    from omegaconf import DictConfig

__all__ = ["main"]


@command("calibrate")
def main(config: DictConfig) -> Any:
    """Command line of calibration."""
    from sphericalvision.recipes.commands.calibrate import calibrate

    return calibrate(config)


if __name__ == "__main__":
    main()
