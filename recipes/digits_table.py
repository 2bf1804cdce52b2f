# SPDX-License-Identifier: Apache-2.0
"""The table N/N, N/R, R/R of digits on the sphere: ``python -m sphericalvision.recipes.digits_table runs=...``."""

from sphericalvision.recipes.app.command import command

main = command("digits_table")

if __name__ == "__main__":
    main()
