# SPDX-License-Identifier: Apache-2.0
"""The lowest versions that ``pyproject.toml`` allows, as constraints for pip: ``python tests/lowest_versions.py``.

``make test-lowest`` installs these in an environment of its own and runs the core's tests there.
"""

import re
import sys
import tomllib
from pathlib import Path

__all__ = ["lowest_versions"]

PYPROJECT = Path(__file__).resolve().parents[1] / "pyproject.toml"
EXTRAS = ("recipes",)
BOUND = re.compile(r"(?P<name>[A-Za-z0-9._-]+)(?:\[[^\]]*\])?>=(?P<version>[0-9.]+)")


def lowest_versions(extras: tuple[str, ...] = EXTRAS) -> dict[str, str]:
    """Name -> version of the dependencies, with those of some extras."""
    project = tomllib.loads(PYPROJECT.read_text())["project"]
    wanted = [
        *project["dependencies"],
        *(word for extra in extras for word in project["optional-dependencies"][extra]),
    ]
    found = {}
    for word in wanted:
        bound = BOUND.match(word)
        if bound is None:
            raise ValueError(f"pyproject.toml: {word!r} has no lower bound, name>=version")
        found[bound["name"]] = bound["version"]
    return found


if __name__ == "__main__":
    left_out = set(sys.argv[1:])
    print(
        "\n".join(
            f"{name}=={version}.*" for name, version in lowest_versions().items() if name not in left_out
        )
    )
