# SPDX-License-Identifier: Apache-2.0
"""The table N/N, N/R, R/R of digits on the sphere: ``python -m sphericalvision.recipes.digits_table runs=...``.

What it does is in ``recipes/commands/digits_table.py``, imported once the command line has been read.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from sphericalvision.recipes.app.command import command, output_folder

if TYPE_CHECKING:
    from omegaconf import DictConfig

__all__ = ["main"]


@command("digits_table")
def main(config: DictConfig) -> Any:
    """Command line of the table."""
    from sphericalvision.recipes.commands.digits_table import digits_table

    return digits_table(config, output_folder())


if __name__ == "__main__":
    main()
