# SPDX-License-Identifier: Apache-2.0
"""The old name of ``sphericalvision-speed``; "benchmark" is that of depth methods."""

import sys

from sphericalvision.recipes import speed


def main() -> None:
    """Say the new name, and do the same."""
    print("sphericalvision-benchmark is called sphericalvision-speed now; it does the same.", file=sys.stderr)
    speed.main()


if __name__ == "__main__":
    main()
