# SPDX-License-Identifier: Apache-2.0
"""``python -m sphericalvision.recipes.study``."""

from sphericalvision.recipes.study import main

main()
