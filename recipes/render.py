# SPDX-License-Identifier: Apache-2.0
"""Render a data set in the layout of OmniThings: ``sphericalvision-render output=... num_frames=...``.

What it does is in ``recipes/commands/render.py``, imported once the command line has been read.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from sphericalvision.recipes.app.command import command

if TYPE_CHECKING:
    from omegaconf import DictConfig

__all__ = ["main"]


@command("render")
def main(config: DictConfig) -> Any:
    """Command line of rendering."""
    from sphericalvision.recipes.commands.render import render

    return render(config, Path(config.output).absolute())  # shards of a multi-run share it


if __name__ == "__main__":
    main()
