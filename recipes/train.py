# SPDX-License-Identifier: Apache-2.0
"""Train a network: ``sphericalvision-train experiment=quickstart`` (depth), ``experiment=spherical_digits``."""

from sphericalvision.recipes.app.command import Command

main = Command("train", "commands.train:train_objective")

if __name__ == "__main__":
    main()
