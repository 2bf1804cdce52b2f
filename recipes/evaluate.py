# SPDX-License-Identifier: Apache-2.0
"""The paper's table row of a checkpoint: ``sphericalvision-evaluate checkpoint=... data=...``.

What it does is in ``recipes/commands/evaluate.py``, imported once the command line has been read.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from sphericalvision.recipes.app.command import command, output_folder

if TYPE_CHECKING:
    from omegaconf import DictConfig

__all__ = ["main"]


@command("evaluate")
def main(config: DictConfig) -> Any:
    """Command line of evaluation."""
    from sphericalvision.recipes.commands.evaluate import evaluate_checkpoint

    return evaluate_checkpoint(config, output_folder())


if __name__ == "__main__":
    main()
