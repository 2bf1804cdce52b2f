# SPDX-License-Identifier: Apache-2.0
"""glTF files before trimesh reads them: what it would read wrongly, or with too much memory, is refused."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from sphericalvision.core import FileFormatError

MOST_EMPTY = 2**20
"""Points of accessors without a buffer, which are zeros."""
DRACO = "KHR_draco_mesh_compression"
READ = (DRACO, "EXT_texture_webp", "KHR_lights_punctual")
"""Required extensions that trimesh reads, besides those of how materials shine, which are not drawn."""
BYTE, FLOAT = 5121, 5126
"""Component types of accessors."""


def check_gltf(path: Path) -> None:
    """Check what a glTF file declares; trimesh itself reports what is damaged."""
    content = path.read_bytes()
    end = 20 + int.from_bytes(content[12:16], "little") if content[:4] == b"glTF" else None
    try:
        problem = next(_problems(json.loads(content[20:end] if end else content)), None)
    except (ValueError, LookupError, TypeError, AttributeError):
        return
    if problem:
        raise FileFormatError(f"{path}: {problem}")


def _problems(header: Mapping[str, Any]) -> Iterator[str]:
    accessors, materials = header.get("accessors", []), header.get("materials", [])
    empty = sum(int(accessor["count"]) for accessor in accessors if "bufferView" not in accessor)
    if empty > MOST_EMPTY:
        yield f"expected at most {MOST_EMPTY:,} points in accessors without a buffer, got {empty:,}"
    for name in header.get("extensionsRequired", ()):
        if name not in READ and not name.startswith("KHR_materials_"):
            yield f"it needs the extension {name}, which is not read; export it without"
        if name == DRACO and find_spec("DracoPy") is None:
            yield "it is compressed by Draco; pip install DracoPy, or export it without"
    for primitive in (primitive for mesh in header.get("meshes", ()) for primitive in mesh["primitives"]):
        attributes: Mapping[str, int] = primitive["attributes"]
        for name, index in (*attributes.items(), ("indices", primitive.get("indices"))):
            accessor = {} if index is None else accessors[index]
            if "sparse" in accessor:
                yield f"its {name} has a sparse accessor, which is not read; export it without"
            types = {"COLOR": (BYTE, FLOAT), "TEXCOORD": (FLOAT,), "POSITION": (FLOAT,)}
            allowed = types.get(name.partition("_")[0])
            if allowed and accessor.get("componentType") not in allowed:
                yield f"its {name} is quantised, which is not read; export it as floating point numbers"
        if "material" in primitive and not _is_on_first_coordinates(materials[primitive["material"]]):
            yield (
                "its texture is moved by KHR_texture_transform or on other coordinates than TEXCOORD_0, which is not "
                "read; export it with the textures baked"
            )


def _is_on_first_coordinates(material: Mapping[str, Any]) -> bool:
    texture = material.get("pbrMetallicRoughness", {}).get("baseColorTexture", {})
    return texture.get("texCoord", 0) == 0 and "KHR_texture_transform" not in texture.get("extensions", {})
