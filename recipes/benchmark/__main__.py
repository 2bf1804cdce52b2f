# SPDX-License-Identifier: Apache-2.0
"""``python -m sphericalvision.recipes.benchmark``."""

from sphericalvision.recipes.benchmark import main

main()
