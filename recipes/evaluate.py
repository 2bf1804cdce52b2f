# SPDX-License-Identifier: Apache-2.0
"""The paper's table row of a checkpoint: ``sphericalvision-evaluate checkpoint=... data=...``."""

from sphericalvision.recipes.app.command import Command

main = Command("evaluate", "commands.evaluate:evaluate_checkpoint")

if __name__ == "__main__":
    main()
