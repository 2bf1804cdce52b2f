# SPDX-License-Identifier: Apache-2.0
"""Numbers and pictures of a rig: ``sphericalvision-inspect calibration=capture/config.yaml``."""

from sphericalvision.recipes.app.command import Command

main = Command("inspect")

if __name__ == "__main__":
    main()
