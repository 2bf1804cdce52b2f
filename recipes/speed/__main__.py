# SPDX-License-Identifier: Apache-2.0
"""``python -m sphericalvision.recipes.speed``."""

from sphericalvision.recipes.speed import main

main()
