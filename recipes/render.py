# SPDX-License-Identifier: Apache-2.0
"""Render a data set in the layout of OmniThings: ``sphericalvision-render output=... num_frames=...``.

What it does is in ``recipes/commands/render.py``, imported once the command line has been read.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from sphericalvision.recipes.app.command import command, output_folder

if TYPE_CHECKING:
    from omegaconf import DictConfig

__all__ = ["main"]


@command("render")
def main(config: DictConfig) -> Any:
    """Command line of rendering."""
    from sphericalvision.recipes.commands.render import render

    return render(config, output_folder())


if __name__ == "__main__":
    main()
