# SPDX-License-Identifier: Apache-2.0
"""A network with a rig inside, as a program: ``sphericalvision-export calibration=rig.yaml min_depth=0.5``."""

from sphericalvision.recipes.app.command import Command

main = Command("export")

if __name__ == "__main__":
    main()
