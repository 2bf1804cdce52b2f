# SPDX-License-Identifier: Apache-2.0
"""The header of a PLY file: how many elements of each name it declares, and of which types their properties are."""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import islice, takewhile
from pathlib import Path

from sphericalvision.core import FileFormatError

MAX_LINES = 1000


@dataclass
class PlyHeader:
    """What a PLY file declares.

    Attributes:
        counts: element -> number of them.
        properties: element -> property -> type, both as they are spelled; lists are left out.
        textures: number of texture images.
    """

    counts: dict[str, int] = field(default_factory=dict)
    properties: dict[str, dict[str, str]] = field(default_factory=dict)
    textures: int = 0

    def check_vertices(self, path: Path, count: int) -> None:
        """Compare the number of vertices that were read with the declared one.

        Raises:
            FileFormatError: they differ; readers return the shorter cloud of a file that was cut.
        """
        declared = self.counts.get("vertex", 0)
        if count != declared:
            raise FileFormatError(
                f"{path}: expected {declared:,} vertices as its header declares, got {count:,}; the file is cut short "
                "or damaged: copy it again"
            )


def read_ply_header(path: Path) -> PlyHeader:
    """Read the lines before ``end_header``.

    Raises:
        FileFormatError: a count is no whole number.
    """
    header, element = PlyHeader(), ""
    with path.open("rb") as file:
        lines = takewhile(lambda line: line.strip() != b"end_header", islice(file, MAX_LINES))
        for line in lines:
            match line.decode("latin-1").split():
                case ["comment", "TextureFile", *_]:
                    header.textures += 1
                case ["element", element, count]:
                    if not count.isdigit():
                        raise FileFormatError(f"{path}: expected a whole number of {element}, got {count!r}")
                    header.counts[element] = int(count)
                    header.properties[element] = {}
                case ["property", type_name, *name] if element and type_name != "list":
                    header.properties[element][" ".join(name)] = type_name
                case _:
                    pass
    return header
