# SPDX-License-Identifier: Apache-2.0
"""What a rig is and sees, in numbers and pictures: ``sphericalvision-inspect calibration=capture/config.yaml``.

What it does is in ``recipes/commands/inspect.py``, imported once the command line has been read.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from sphericalvision.recipes.app.command import command, output_folder

if TYPE_CHECKING:
    from omegaconf import DictConfig

__all__ = ["main"]


@command("inspect")
def main(config: DictConfig) -> Any:
    """Command line of inspection."""
    from sphericalvision.recipes.commands.inspect import inspect

    return inspect(config, output_folder())


if __name__ == "__main__":
    main()
