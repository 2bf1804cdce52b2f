# SPDX-License-Identifier: Apache-2.0
"""glTF files made ready for trimesh: numbers of all kinds, texture coordinates as materials want them, or refused."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from importlib.util import find_spec
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from sphericalvision.core import FileFormatError

__all__ = ["NUMBERS", "Gltf", "in_floats"]

MOST_EMPTY = 2**20
"""Points of accessors without a buffer, which are zeros."""
NUMBERS = "SPHERICALVISION_numbers"
"""An extension that all triangles are given: by it trimesh has their numbers made ready before it reads them."""
DRACO = "KHR_draco_mesh_compression"
READ = (DRACO, "KHR_mesh_quantization", "KHR_texture_transform", "EXT_texture_webp", "KHR_lights_punctual")
"""Extensions without which a file cannot be read, besides those that say how materials shine."""


class Gltf:
    """What a file holds beside its buffers, and the file with ``NUMBERS``; as it is if it is damaged.

    Raises:
        FileFormatError: it needs an extension that is not read, or its accessors hold what is not in its bytes.
    """

    def __init__(self, path: Path) -> None:
        content = path.read_bytes()
        binary = content[:4] == b"glTF"
        end = 20 + int.from_bytes(content[12:16], "little") if binary else len(content)
        self.header: dict[str, Any] = {}
        self.file = BytesIO(content)
        try:
            header = json.loads(content[20:end] if binary else content)
            self._check(path, header)
            for mesh in header.get("meshes", ()):
                for primitive in mesh["primitives"]:
                    primitive.setdefault("extensions", {})[NUMBERS] = {}
            text = json.dumps(header).encode()
        except FileFormatError:
            raise
        except Exception:  # trimesh says what is wrong
            return
        self.header = header
        if binary:
            text += b" " * (-len(text) % 4)
            sizes = [
                number.to_bytes(4, "little") for number in (20 + len(text) + len(content) - end, len(text))
            ]
            text = b"".join((content[:8], *sizes, content[16:20], text, content[end:]))
        self.file = BytesIO(text)

    def _check(self, path: Path, header: Mapping[str, Any]) -> None:
        accessors = header.get("accessors", ())
        empty = sum(int(accessor["count"]) for accessor in accessors if "bufferView" not in accessor)
        if empty > MOST_EMPTY:
            raise FileFormatError(
                f"{path}: its accessors without a buffer hold {empty:,} points, all zero; expected {MOST_EMPTY:,} at "
                "most"
            )
        for name in header.get("extensionsRequired", ()):
            if name not in READ and not name.startswith("KHR_materials_"):
                raise FileFormatError(
                    f"{path}: it needs the extension {name}, which is not read; export it without"
                )
            if name == DRACO and find_spec("DracoPy") is None:
                raise FileFormatError(
                    f"{path}: it is compressed by Draco; pip install DracoPy, or export it without"
                )
        used = {
            number
            for mesh in header.get("meshes", ())
            for primitive in mesh["primitives"]
            for number in (*primitive["attributes"].values(), primitive.get("indices", -1))
        }
        if any("sparse" in accessor for number, accessor in enumerate(accessors) if number in used):
            raise FileFormatError(
                f"{path}: its triangles have sparse accessors, which are not read; export it without"
            )


def in_floats(header: Mapping[str, Any], context: Mapping[str, Any]) -> None:
    """Make whole numbers that stand for shares floats, and texture coordinates those of the picture of colours.

    Args:
        header: of a ``Gltf``.
        context: what trimesh has of a piece: its ``primitive``, and ``accessors``, the arrays of all.
    """
    arrays, attributes = context["accessors"], context["primitive"]["attributes"]

    def replace(name: str, values: Any) -> None:
        attributes[name] = len(arrays)
        arrays.append(values.astype(np.float32))

    for name, number in list(attributes.items()):
        values = arrays[number]
        shares = header["accessors"][number].get("normalized") or name.startswith(("TEXCOORD_", "COLOR_"))
        if shares and values.dtype.kind in "iu":
            replace(name, np.maximum(values / np.iinfo(values.dtype).max, -1.0))
    if "material" not in context["primitive"]:
        return
    material = header["materials"][context["primitive"]["material"]]
    texture = material.get("pbrMetallicRoughness", {}).get("baseColorTexture", {})
    transform = texture.get("extensions", {}).get("KHR_texture_transform", {})
    name = f"TEXCOORD_{transform.get('texCoord', texture.get('texCoord', 0))}"
    if name in attributes and (transform or name != "TEXCOORD_0"):
        angle, offset = transform.get("rotation", 0.0), transform.get("offset", (0.0, 0.0))
        turn = np.array([[math.cos(angle), math.sin(angle)], [-math.sin(angle), math.cos(angle)]])
        replace("TEXCOORD_0", arrays[attributes[name]] * transform.get("scale", (1.0, 1.0)) @ turn.T + offset)
