# SPDX-License-Identifier: Apache-2.0
"""YAML, JSON and XML, parsed without running anything.

OpenCV's FileStorage writes a YAML of its own: its first line is ``%YAML:1.0``, and matrices carry the tag
``!!opencv-matrix``. Both are understood here, so that all mappings reach their readers as plain dictionaries.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from sphericalvision.cameras.calibration.keys import Keys, with_keys
from sphericalvision.core import FileFormatError
from sphericalvision.io.files import read_text, write_bytes
from sphericalvision.io.yaml_files import parse_yaml

STRUCTURED = (".yaml", ".yml", ".json", ".xml")
"""Suffixes of files that hold keys with values."""


def looks_structured(path: Path) -> bool:
    """Whether a file holds keys with values, by its suffix or its first characters."""
    if path.suffix.lower() in STRUCTURED:
        return True
    text = read_text(path).lstrip()
    is_yaml = path.suffix != ".txt" and re.match(r"(\s*(#.*\n|---\s))*\s*[A-Za-z][\w.]*:(\s|$)", text)
    return bool(is_yaml) or text.startswith(("%YAML", "<?xml", "{"))


def data_lines(path: Path) -> list[tuple[int, list[str]]]:
    """Line numbers from 1 and the words of lines that hold data; ``#`` starts a comment."""
    lines = enumerate(read_text(path).splitlines(), start=1)
    return [(number, words) for number, line in lines if (words := line.split("#")[0].split())]


def load(path: Path) -> Any:
    """The contents of a YAML, JSON or XML file as ``Keys``, lists, numbers and strings.

    Of an XML that is not OpenCV's the name of the root is the only key; attributes and children are keys alike.
    """
    text = read_text(path)
    start = text.lstrip()
    try:
        if start.startswith(("<?xml", "<opencv_storage")) or path.suffix.lower() == ".xml":
            root = parse_xml(text, path)
            is_opencv = root.tag == "opencv_storage"
            content = _from_element(root, path) if is_opencv else {root.tag: from_xml(root, path)}
            return with_keys(content, str(path))
        if path.suffix.lower() == ".json":
            content = json.loads(text, object_pairs_hook=lambda pairs: once(pairs, path))
            return with_keys(content, str(path))
        if start.startswith("%YAML"):  # "%YAML:1.0" is no directive that YAML knows
            text = text.replace("%YAML", "# ", 1)
            # Its "key:1" is no pair to YAML
            text = re.sub(r"^([ \t]*[\w.]+):(?=[^\s:])", r"\1: ", text, flags=re.MULTILINE)
        return with_keys(parse_yaml(text, str(path)), str(path))
    except json.JSONDecodeError as error:
        remedy = "keep one of its values" if error.msg == "Extra data" else "is it truncated?"
        raise FileFormatError(f"{path}: not valid json ({error}); {remedy}") from None
    except FileFormatError:
        raise
    except (ValueError, RecursionError) as error:  # a number too long; nesting without end
        raise FileFormatError(f"{path}: cannot be parsed ({error})") from None


def load_keys(path: Path, what: str) -> Keys:
    """``load`` of a file that must hold keys with values; ``what`` they are, in the error if it does not."""
    content = load(path)
    if not isinstance(content, Keys):
        raise FileFormatError(f"{path}: expected {what} with values")
    return content


def once(pairs: Iterable[tuple[str, Any]], path: Path) -> dict[str, Any]:
    """The mapping of pairs, each key of which may stand there once."""
    content: dict[str, Any] = {}
    for key, value in pairs:
        if key in content:
            raise FileFormatError(f"{path}: the key {key!r:.80} stands twice")
        content[key] = value
    return content


def parse_xml(text: str, path: Path) -> ElementTree.Element:
    """The root of an XML, which must not have what expands without end."""
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise FileFormatError(f"{path}: a calibration has no document type or entities, this file has")
    try:
        return ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise FileFormatError(f"{path}: not valid XML ({error}); is it truncated?") from None


def write_json(path: Path, content: Any) -> None:
    """Write keys with values as JSON, replacing the file at once."""
    write_bytes(path, (json.dumps(content, indent=1) + "\n").encode())


def from_xml(element: ElementTree.Element, path: Path) -> Any:
    """The text of an element, or its attributes and children as keys; of several children of a name a list.

    Where there are attributes, text has the key ``text``. Names are without their namespaces.
    """
    pairs: list[tuple[str, Any]] = [(_bare(name), value) for name, value in element.attrib.items()]
    children: dict[str, list[Any]] = {}
    for child in element:
        children.setdefault(_bare(child.tag), []).append(from_xml(child, path))
    pairs += [(name, values if len(values) > 1 else values[0]) for name, values in children.items()]
    text = (element.text or "").strip()
    if not pairs:
        return text
    return once([*pairs, ("text", text)] if text else pairs, path)


def _bare(name: Any) -> str:
    return str(name).rsplit("}", 1)[-1]


def _from_element(element: ElementTree.Element, path: Path) -> Any:
    children = list(element)
    if children and all(child.tag == "_" for child in children):
        return [_from_element(child, path) for child in children]
    if children or element.tag == "opencv_storage":
        return once([(child.tag, _from_element(child, path)) for child in children], path)
    tokens = (element.text or "").split()
    if element.tag == "data":
        return tokens
    return tokens[0].strip('"') if len(tokens) == 1 else tokens
