# SPDX-License-Identifier: Apache-2.0
"""YAML, JSON and XML, parsed without running anything.

OpenCV's FileStorage writes a YAML of its own: its first line is ``%YAML:1.0``, and matrices carry the tag
``!!opencv-matrix``. Both are understood here, so that all mappings reach their readers as plain dictionaries.
"""

from __future__ import annotations

import json
import re
from collections.abc import Hashable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any
from xml.etree import ElementTree

import yaml

from sphericalvision.cameras.calibration.keys import Keys, with_keys
from sphericalvision.core import FileFormatError
from sphericalvision.io.files import atomic_write

__all__ = [
    "STRUCTURED",
    "data_lines",
    "from_xml",
    "load",
    "load_keys",
    "looks_structured",
    "once",
    "parse_xml",
    "read_text",
    "write_json",
]

STRUCTURED = (".yaml", ".yml", ".json", ".xml")
"""Suffixes of files that hold keys with values."""
MOST_KEYS = 10_000
"""Of one mapping."""


def read_text(path: Path) -> str:
    """The text of a file, in UTF-8, or in UTF-16 if it begins with a byte order mark, as Windows' shells write it.

    Raises:
        FileFormatError: it is binary, or text in another encoding; the message says which it is.
    """
    data = path.read_bytes()
    is_marked = data[:2] in (b"\xff\xfe", b"\xfe\xff")
    bad = None
    try:
        text = data.decode("utf-16" if is_marked else "utf-8-sig")
    except UnicodeDecodeError as error:
        text, bad = "", error.start
    if re.search("[\0-\x08\x0e-\x1f]", text or ("" if is_marked else data.decode("latin-1"))):
        is_wide = 0.4 * len(data) < data.count(b"\0") < 0.6 * len(data)
        kind = "UTF-16 without a byte order mark; save it as UTF-8" if is_wide else "binary data"
        raise FileFormatError(f"{path}: expected a text file, got {kind}")
    if bad is not None:
        raise FileFormatError(
            f"{path}, line {data[:bad].count(bytes([10])) + 1}: expected text in UTF-8, got the byte "
            f"0x{data[bad]:02x}, as in cp1252 or Latin-1 of Windows; save the file as UTF-8"
        )
    return text.replace("\r\n", "\n").replace("\r", "\n")


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

    Raises:
        FileFormatError: it cannot be parsed; the message names the line.
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
            text = re.sub(
                r"^([ \t]*[\w.]+):(?=[^\s:])", r"\1: ", text, flags=re.MULTILINE
            )  # its "key:1" is no pair to YAML
        return with_keys(_one_document(text, path), str(path))
    except json.JSONDecodeError as error:
        raise FileFormatError(f"{path}: not valid json ({error}); is it truncated?") from None
    except yaml.YAMLError as error:
        raise FileFormatError(f"{path}: not valid YAML ({' '.join(str(error).split())})") from None
    except FileFormatError:
        raise
    except (ValueError, RecursionError) as error:  # a date that does not exist; nesting without end
        raise FileFormatError(f"{path}: cannot be parsed ({error})") from None


def load_keys(path: Path, what: str) -> Keys:
    """``load`` of a file that must hold keys with values; ``what`` they are, in the error if it does not."""
    content = load(path)
    if not isinstance(content, Keys):
        raise FileFormatError(f"{path}: expected {what} with values")
    return content


def _one_document(text: str, path: Path) -> Any:
    """The YAML document of a file, or the first of several that differ in no more than their headers.

    Messages of a topic, as ROS prints them, end in ``---``, behind which there may be another one, or nothing.
    """
    parts = re.split(r"(?m)^(?:---|\.\.\.)(?=\s|$)", text)
    ignored = (
        r"(?m)^[ \t]*(#.*)?\n|^header:.*\n([ \t]+.*\n)*"  # neither comments nor blank lines nor headers count
    )
    if (count := len({re.sub(ignored, "", f"{part}\n").strip() for part in parts} - {""})) > 1:
        raise FileFormatError(f"{path}: holds {count} YAML documents that differ; keep the one to be read")
    return next((document for document in yaml.load_all(text, Loader=_Loader) if document is not None), None)


def once(pairs: Iterable[tuple[str, Any]], path: Path) -> dict[str, Any]:
    """The mapping of pairs, each key of which may stand there once."""
    content: dict[str, Any] = {}
    for key, value in pairs:
        if key in content:
            raise FileFormatError(f"{path}: the key {key!r:.80} stands twice")
        content[key] = value
    return content


if TYPE_CHECKING:
    _SafeLoader = yaml.SafeLoader
else:  # the parser in C is twice as fast, and limits how deep a file may nest
    _SafeLoader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


class _Loader(_SafeLoader):
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

    def construct_decimal(self, node: yaml.ScalarNode) -> Any:
        """A number as everybody means it: to YAML 1:30 is 90, and 010 is 8."""
        if re.search(r":|^[-+]?0[\d_]", node.value):
            return node.value
        is_whole = node.tag.endswith("int")
        return self.construct_yaml_int(node) if is_whole else self.construct_yaml_float(node)

    def construct_matrix(self, node: yaml.Node) -> Any:
        if not isinstance(node, yaml.MappingNode):
            raise yaml.constructor.ConstructorError(
                None, None, "expected rows, cols, dt and data", node.start_mark
            )
        return self.construct_mapping(node, deep=True)


for _name in ("int", "float"):
    _Loader.add_constructor(f"tag:yaml.org,2002:{_name}", _Loader.construct_decimal)
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
    words = (element.text or "").split()
    if element.tag == "data":
        return words
    return words[0].strip('"') if len(words) == 1 else words
