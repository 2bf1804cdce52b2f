# SPDX-License-Identifier: Apache-2.0
"""A camera from images of a checkerboard: ``sphericalvision-calibrate images=*.png board=9x6 square=0.03``."""

from sphericalvision.recipes.app.command import command

main = command("calibrate", folder=False)

if __name__ == "__main__":
    main()
