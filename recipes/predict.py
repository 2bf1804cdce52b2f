# SPDX-License-Identifier: Apache-2.0
"""Depth of one's own captures: ``sphericalvision-predict calibration=... images='c/cam{camera}/{frame:05d}.png'``.

What it does is in ``recipes/commands/predict.py``, imported once the command line has been read.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from sphericalvision.recipes.app.command import command, output_folder

if TYPE_CHECKING:
    from omegaconf import DictConfig

__all__ = ["main"]


@command("predict")
def main(config: DictConfig) -> Any:
    """Command line of prediction."""
    from sphericalvision.recipes.commands.predict import predict

    return predict(config, output_folder())


if __name__ == "__main__":
    main()
