# SPDX-License-Identifier: Apache-2.0
"""Files of meshes that others made: what they name is read from their own folder only, and only so much of it."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import trimesh
from trimesh.exchange.gltf.extensions import _handlers as handlers
from trimesh.util import log

from sphericalvision.core import FileFormatError, MissingFileError
from sphericalvision.io.ply_header import PlyHeader, read_ply_header
from sphericalvision.scenes.rendering.gltf import check_gltf

SPECULAR = "KHR_materials_pbrSpecularGlossiness"


def load_mesh(path: Path) -> trimesh.Scene:
    """Read a mesh and the textures that it names; a warning says which of these could not be had."""
    folder, suffix = MeshFolder(path.parent), path.suffix.lower()
    if suffix in (".gltf", ".glb"):
        check_gltf(path)
    if suffix == ".off":
        _check_off_colours(path)
    header = read_ply_header(path) if suffix == ".ply" else None
    if header is not None:
        _check_ply_colours(path, header)
    # Else corners in one place would become one, of one of their colours. Formats without colours save memory by that.
    options: dict[str, Any] = {"process": False} if suffix in (".ply", ".obj") else {}
    try:
        with _complaints(folder.missing), path.open("rb") as file:
            loaded = trimesh.load_scene(file, suffix[1:], resolver=folder, **options)
        for part in loaded.geometry.values():
            if header is not None:
                header.check_vertices(path, len(part.vertices))
            if isinstance(part, trimesh.Trimesh):
                part.remove_infinite_values()
                part.remove_unreferenced_vertices()
    except FileFormatError:
        raise
    except Exception as error:  # readers of damaged files raise nearly anything
        raise FileFormatError(
            f"{path}: cannot be read as a mesh ({type(error).__name__}: {error})"
        ) from error
    if missing := list(dict.fromkeys(folder.missing)):
        more = f", and {len(missing) - 3} more" if len(missing) > 3 else ""
        warnings.warn(
            f"{path}: what it names could not be read, and surfaces go without: {'; '.join(missing[:3])}{more}. "
            "Textures and materials lie in the folder of the mesh, or below it",
            stacklevel=3,
        )
    return loaded


def _check_off_colours(path: Path) -> None:
    """Raise for an OFF file with colours, which trimesh passes over."""
    lines = [
        words
        for line in path.read_text(errors="replace").splitlines()
        if (words := line.partition("#")[0].split())
    ]
    try:
        sizes = lines[0][1:] if len(lines[0]) > 1 else lines.pop(1)
        faces = lines[1 + int(sizes[0]) :][: int(sizes[1])]
        coloured = "C" in lines[0][0].removesuffix("OFF") or any(
            len(face) > int(face[0]) + 1 for face in faces
        )
    except (ValueError, IndexError):  # trimesh says what is wrong
        return
    if coloured:
        raise FileFormatError(f"{path}: colours of OFF files are not read; a PLY with colours of vertices is")


def _check_ply_colours(path: Path, header: PlyHeader) -> None:
    """Raise for a PLY file whose colours trimesh passes over, wraps around or takes from one picture of several."""
    if header.textures > 1:
        raise FileFormatError(
            f"{path}: it has {header.textures} textures, of which one is read; expected one, or an OBJ or glTF file"
        )
    for name, kind in (item for types in header.properties.values() for item in types.items()):
        lower = name.lower()
        if not lower.endswith("red") and lower != "r":
            continue
        if lower != "red" or kind not in ("uchar", "uint8", "float", "float32", "double", "float64"):
            raise FileFormatError(
                f"{path}: its colours are {kind} {name!r}, which are not read; expected uchar 'red', 'green' and 'blue'"
            )


class MeshFolder(Mapping[str, bytes]):
    """What a mesh names (materials, textures, buffers), by name: regular files in its folder, and in folders there."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder.resolve()
        self.missing: list[str] = []

    def __getitem__(self, name: str) -> bytes:
        """The content of a file, by the name that the mesh has for it.

        Raises:
            MissingFileError: there is no such file below the folder of the mesh, or it is no regular one.
        """
        name = name.strip()
        for spelled in (name, unquote(name), name.replace("\\", "/").rpartition("/")[2]):
            file = (self.folder / spelled).resolve()  # where links lead to
            # No pipe, which could be waited for in vain
            if file.is_relative_to(self.folder) and file.is_file():
                return file.read_bytes()
        self.missing.append(f"{name}: no such file below {self.folder}")
        raise MissingFileError(self.missing[-1])

    def __iter__(self) -> Iterator[str]:
        return iter(())  # nothing is offered that was not asked for

    def __len__(self) -> int:
        return 0


@contextmanager
def _complaints(messages: list[str]) -> Iterator[None]:
    """Add to ``messages`` what trimesh cannot load meanwhile: it goes on without, and tells only its log.

    Textures of the extension `SPECULAR` stay packed meanwhile: trimesh would unpack and mix them, of whatever size.
    """
    before, shown = log.level, log.getEffectiveLevel()
    specular = handlers["material"][SPECULAR]

    def keep(record: logging.LogRecord) -> bool:
        if record.exc_info and record.exc_info[1] is not None:
            messages.append(str(record.exc_info[1]))
        return record.levelno >= shown

    log.addFilter(keep)
    handlers["material"][SPECULAR] = _colours_only
    log.setLevel(logging.DEBUG)
    try:
        yield
    finally:
        log.setLevel(before)
        log.removeFilter(keep)
        handlers["material"][SPECULAR] = specular


def _colours_only(context: Mapping[str, Any]) -> dict[str, Any]:
    """What is drawn of a material with `SPECULAR`, as trimesh names it."""
    values = context["parse_textures"](data=context["data"])
    names = {"diffuseTexture": "baseColorTexture", "diffuseFactor": "baseColorFactor"}
    return {names[name]: value for name, value in values.items() if name in names}
