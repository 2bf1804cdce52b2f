# SPDX-License-Identifier: Apache-2.0
"""Four rendered fisheye images to a depth map of the full sphere: ``python -m sphericalvision.recipes.demo``."""

from sphericalvision.recipes.app.command import Command

main = Command("demo")

if __name__ == "__main__":
    main()
