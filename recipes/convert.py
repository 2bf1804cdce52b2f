# SPDX-License-Identifier: Apache-2.0
"""Cameras as another model or file: ``sphericalvision-convert calibration=a.yaml to=kannala_brandt output=b.yaml``.

What it does is in ``recipes/commands/convert.py``, imported once the command line has been read.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from sphericalvision.recipes.app.command import command

if TYPE_CHECKING:
    from omegaconf import DictConfig

__all__ = ["main"]


@command("convert")
def main(config: DictConfig) -> Any:
    """Command line of conversion."""
    from sphericalvision.recipes.commands.convert import convert

    return convert(config)


if __name__ == "__main__":
    main()
