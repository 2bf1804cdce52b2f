# SPDX-License-Identifier: Apache-2.0
"""Depth methods side by side, on scenes that no training uses: ``sphericalvision-benchmark``."""

from sphericalvision.recipes.app.command import Command

main = Command("benchmark", "evaluation.benchmark:benchmark")

if __name__ == "__main__":
    main()
