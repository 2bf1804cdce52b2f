# SPDX-License-Identifier: Apache-2.0
"""Cameras from images of a board: ``sphericalvision-calibrate images=board/{camera}/*.png board=target.yaml``."""

from sphericalvision.recipes.app.command import Command

main = Command("calibrate")

if __name__ == "__main__":
    main()
