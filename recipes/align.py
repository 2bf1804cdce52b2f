# SPDX-License-Identifier: Apache-2.0
"""Orientations of a rig's cameras from its own images: ``sphericalvision-align calibration=rig.yaml images=…``."""

from sphericalvision.recipes.app.command import Command

main = Command("align")

if __name__ == "__main__":
    main()
