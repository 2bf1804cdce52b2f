# SPDX-License-Identifier: Apache-2.0
"""Cameras as another model or file: ``sphericalvision-convert calibration=a.yaml to=kannala_brandt output=b.yaml``."""

from sphericalvision.recipes.app.command import Command

main = Command("convert")

if __name__ == "__main__":
    main()
