# SPDX-License-Identifier: Apache-2.0
"""Four rendered fisheye images to a depth map of the full sphere: ``python -m sphericalvision.recipes.demo``.

What it does is in ``recipes/commands/demo.py``, imported once the command line has been read.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from sphericalvision.recipes.app.command import command, output_folder

if TYPE_CHECKING:
    from omegaconf import DictConfig

__all__ = ["main"]


@command("demo")
def main(config: DictConfig) -> Any:
    """Command line of the demonstration."""
    from sphericalvision.recipes.commands.demo import demo

    return demo(config, output_folder())


if __name__ == "__main__":
    main()
