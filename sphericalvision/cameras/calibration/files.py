# SPDX-License-Identifier: Apache-2.0
"""YAML, JSON and OpenCV's XML, parsed without running anything.

OpenCV's FileStorage writes a YAML of its own: its first line is ``%YAML:1.0``, and matrices carry the tag
``!!opencv-matrix``. Both are understood here, so that all mappings reach their readers as plain dictionaries.
"""

from __future__ import annotations

import json
import re
from collections.abc import Hashable
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import yaml

from sphericalvision.core import FileFormatError
from sphericalvision.io.files import atomic_write

__all__ = ["STRUCTURED", "data_lines", "load", "looks_structured", "parse_xml", "read_text", "write_json"]

STRUCTURED = (".yaml", ".yml", ".json", ".xml")
"""Suffixes of files that hold keys with values."""
MOST_KEYS = 10_000
"""Of one mapping."""


def read_text(path: Path) -> str:
    """The text of a file; ``FileFormatError`` if it is binary."""
    try:
        return path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError:
        raise FileFormatError(f"{path}: expected a text file, got binary data") from None


def looks_structured(path: Path) -> bool:
    """Whether a file holds keys with values, by its suffix or its first characters."""
    return path.suffix.lower() in STRUCTURED or read_text(path).lstrip().startswith(("%YAML", "<?xml", "{"))


def data_lines(path: Path) -> list[tuple[int, list[str]]]:
    """Line numbers from 1 and the words of lines that hold data; ``#`` starts a comment."""
    lines = enumerate(read_text(path).splitlines(), start=1)
    return [(number, words) for number, line in lines if (words := line.split("#")[0].split())]


def load(path: Path) -> Any:
    """The contents of a YAML, JSON or OpenCV XML file as dictionaries, lists, numbers and strings.

    Raises:
        FileFormatError: it cannot be parsed; the message names the line.
    """
    text = read_text(path)
    start = text.lstrip()
    try:
        if start.startswith(("<?xml", "<opencv_storage")):
            return _opencv_xml(text, path)
        if path.suffix.lower() == ".json":
            return json.loads(text)
        if start.startswith("%YAML"):  # "%YAML:1.0" is no directive that YAML knows
            text = text.replace("%YAML", "# ", 1)
            text = re.sub(
                r"^([ \t]*[\w.]+):(?=[^\s:])", r"\1: ", text, flags=re.MULTILINE
            )  # its "key:1" is no pair to YAML
        return yaml.load(text, Loader=_Loader)
    except json.JSONDecodeError as error:
        raise FileFormatError(f"{path}: not valid json ({error}); is it truncated?") from None
    except yaml.YAMLError as error:
        raise FileFormatError(f"{path}: not valid YAML ({' '.join(str(error).split())})") from None
    except FileFormatError:
        raise
    except (ValueError, RecursionError) as error:  # a date that does not exist; nesting without end
        raise FileFormatError(f"{path}: cannot be parsed ({error})") from None


class _Loader(yaml.SafeLoader):
    """YAML's safe loader that knows OpenCV's matrices and refuses a key that stands twice."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Hashable, Any]:
        seen: set[str] = set()
        for key, _ in node.value:
            if key.value in seen if isinstance(key.value, str) else False:
                raise yaml.constructor.ConstructorError(
                    None, None, f"the key {key.value!r} stands twice", key.start_mark
                )
            if isinstance(key.value, str):
                seen.add(key.value)
        return super().construct_mapping(node, deep)

    def flatten_mapping(self, node: yaml.MappingNode) -> None:
        super().flatten_mapping(node)
        if len(node.value) > MOST_KEYS:  # merges of merges of aliases: a short file, and no end of keys
            raise yaml.constructor.ConstructorError(
                None, None, f"expected at most {MOST_KEYS} keys", node.start_mark
            )

    def construct_matrix(self, node: yaml.Node) -> Any:
        if not isinstance(node, yaml.MappingNode):
            raise yaml.constructor.ConstructorError(
                None, None, "expected rows, cols, dt and data", node.start_mark
            )
        return self.construct_mapping(node, deep=True)


for _name in ("opencv-matrix", "opencv-nd-matrix"):
    _Loader.add_constructor(f"tag:yaml.org,2002:{_name}", _Loader.construct_matrix)


def parse_xml(text: str, path: Path) -> ElementTree.Element:
    """The root of an XML, which must not have what expands without end.

    Raises:
        FileFormatError: it has a document type or entities, or cannot be parsed; the message names the line.
    """
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise FileFormatError(f"{path}: a calibration has no document type or entities, this file has")
    try:
        return ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise FileFormatError(f"{path}: not valid XML ({error}); is it truncated?") from None


def write_json(path: Path, content: Any) -> None:
    """Write keys with values as JSON, replacing the file at once."""
    with atomic_write(path) as unfinished:
        unfinished.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def _opencv_xml(text: str, path: Path) -> Any:
    root = parse_xml(text, path)
    if root.tag != "opencv_storage":
        raise FileFormatError(f"{path}: expected OpenCV's <opencv_storage>, got <{root.tag}>")
    return _from_element(root)


def _from_element(element: ElementTree.Element) -> Any:
    children = list(element)
    if children and all(child.tag == "_" for child in children):
        return [_from_element(child) for child in children]
    if children or element.tag == "opencv_storage":
        return {child.tag: _from_element(child) for child in children}
    words = (element.text or "").split()
    if element.tag == "data":
        return words
    return words[0].strip('"') if len(words) == 1 else words
