# SPDX-License-Identifier: Apache-2.0
"""Train a network: ``sphericalvision-train experiment=quickstart`` (depth), ``experiment=spherical_digits``.

What it does is in ``recipes/commands/train.py``, imported once the command line has been read.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from sphericalvision.recipes.app.command import command, output_folder

if TYPE_CHECKING:
    from omegaconf import DictConfig

__all__ = ["main"]


@command("train")
def main(config: DictConfig) -> Any:
    """Command line of training."""
    from sphericalvision.recipes.commands.train import objective, train

    return objective(train(config, output_folder()), config.task.monitor)


if __name__ == "__main__":
    main()
