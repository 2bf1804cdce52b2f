# SPDX-License-Identifier: Apache-2.0
"""Depth of one's own captures: ``sphericalvision-predict calibration=... images='c/cam{camera}/{frame:05d}.png'``."""

from sphericalvision.recipes.app.command import Command

main = Command("predict")

if __name__ == "__main__":
    main()
