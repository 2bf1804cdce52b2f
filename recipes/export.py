# SPDX-License-Identifier: Apache-2.0
"""A network with a rig inside, as a program: ``sphericalvision-export calibration=rig.yaml min_depth=0.5``.

What it does is in ``recipes/commands/export.py``, imported once the command line has been read.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from sphericalvision.recipes.app.command import command, output_folder

if TYPE_CHECKING:
    from omegaconf import DictConfig

__all__ = ["main"]


@command("export")
def main(config: DictConfig) -> Any:
    """Command line of exporting."""
    from sphericalvision.recipes.commands.export import export

    return export(config, output_folder())


if __name__ == "__main__":
    main()
