# SPDX-License-Identifier: Apache-2.0
"""Render a data set in the layout of OmniThings: ``sphericalvision-render output=... num_frames=...``."""

from sphericalvision.recipes.app.command import Command

main = Command("render")

if __name__ == "__main__":
    main()
