# SPDX-License-Identifier: Apache-2.0
"""Cameras from images of a board: ``sphericalvision-calibrate images=board/{camera}/*.png board=target.yaml``."""

from sphericalvision.recipes.app.command import command

main = command("calibrate", folder=False)

if __name__ == "__main__":
    main()
