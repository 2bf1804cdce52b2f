# SPDX-License-Identifier: Apache-2.0
"""YAML, read with bounds and without running anything, and written whole.

Everything that is read here may come from a stranger: by aliases a file of 600 bytes may stand for gigabytes, hold
itself, or merge mappings without end. Values are counted as often as they are referred to, before any is built.
"""

from __future__ import annotations

import re
from collections.abc import Hashable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml
from yaml.constructor import ConstructorError

from sphericalvision.core import FileFormatError
from sphericalvision.io.files import read_text, write_bytes

MAX_VALUES = 1_000_000
"""Keys and values of a file, each counted as often as aliases refer to it."""

if TYPE_CHECKING:
    _SafeLoader = yaml.SafeLoader
else:  # the parser in C is twice as fast, and limits how deep a file may nest
    _SafeLoader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


def read_yaml(path: str | Path) -> Any:
    """The content of a YAML file as dictionaries, lists, numbers and strings.

    Raises:
        FileFormatError: see ``parse_yaml``; or it is no text.
    """
    return parse_yaml(read_text(Path(path)), str(path))


def parse_yaml(text: str, where: str) -> Any:
    """The content of the YAML document in a text, or of the first of several that differ in their headers only.

    Messages of a topic, as ROS prints them, end in ``---``, followed by another message or by nothing. Numbers with
    leading zeros or colons are strings (to YAML, 010 is 8 and 1:30 is 90), and so are dates.

    Args:
        text: the whole text of a file.
        where: the file, in errors.

    Raises:
        FileFormatError: the text is not valid YAML, has a key twice, holds more than a million values with those that
            aliases repeat, or several documents that differ; the message names the line if there is one.
    """
    first, *others = _documents(text) or [""]
    if others:
        raise FileFormatError(
            f"{where}: holds {1 + len(others)} YAML documents that differ; keep the one to be read"
        )
    loader = _Loader(first)
    try:
        node = loader.get_single_node()
        if node is None:
            return None
        if (count := _count(node, {})) > MAX_VALUES:
            raise FileFormatError(
                f"{where}: expected at most {MAX_VALUES} values, got {count:.3g}, most of them by aliases (&a, *a); "
                "write them out, or remove them"
            )
        return loader.construct_document(node)
    except yaml.YAMLError as error:
        remedy = (
            "; of several values in sequence, as in JSON lines, keep one" if "document" in str(error) else ""
        )
        raise FileFormatError(f"{where}: not valid YAML ({' '.join(str(error).split())}){remedy}") from None
    except FileFormatError:  # is a ValueError, too
        raise
    except (ValueError, RecursionError) as error:  # a number that does not exist; nesting without end
        raise FileFormatError(f"{where}: cannot be parsed ({error})") from None
    finally:
        loader.dispose()


def _documents(text: str) -> list[str]:
    """The documents of a text that differ in more than comments, blank lines and headers, at their lines."""
    different: dict[str, str] = {}
    start = 0
    for end in [*re.finditer(r"(?m)^(?:---|\.\.\.)(?=\s|$)", text), None]:
        document = text[start : end.start() if end else None]
        content = re.sub(r"(?m)^[ \t]*(#.*)?\n|^header:.*\n([ \t]+.*\n)*", "", f"{document}\n").strip()
        if content:  # the lines above keep the numbers in errors right
            different.setdefault(content, "\n" * text.count("\n", 0, start) + document)
        start = end.end() if end else 0
    return list(different.values())


def _count(node: yaml.Node, counts: dict[int, int | None]) -> int:
    """The number of values in a node, those behind aliases as often as they are referred to."""
    if id(node) in counts:
        count = counts[id(node)]
        if count is None:  # it is being counted further up
            raise ConstructorError(None, None, "an alias refers to what holds it", node.start_mark)
        return count
    if isinstance(node, yaml.ScalarNode):
        return 1
    counts[id(node)] = None
    pairs = isinstance(node, yaml.MappingNode)
    inner = [child for pair in node.value for child in pair] if pairs else node.value
    counts[id(node)] = count = 1 + sum(_count(child, counts) for child in inner)
    return count


class _Loader(_SafeLoader):
    """YAML's safe loader that knows OpenCV's matrices and refuses a key that stands twice."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Hashable, Any]:
        names: set[str] = set()
        for key, _ in node.value:
            if not isinstance(key.value, str):
                continue
            if key.value in names:
                raise ConstructorError(None, None, f"the key {key.value!r} stands twice", key.start_mark)
            names.add(key.value)
        return super().construct_mapping(node, deep)

    def construct_decimal(self, node: yaml.ScalarNode) -> Any:
        """A number as everybody means it: to YAML 1:30 is 90, and 010 is 8; dates are texts."""
        if node.tag.endswith("timestamp") or re.search(r":|^[-+]?0[\d_]", node.value):
            return node.value
        is_whole = node.tag.endswith("int")
        return self.construct_yaml_int(node) if is_whole else self.construct_yaml_float(node)

    def construct_matrix(self, node: yaml.Node) -> Any:
        if not isinstance(node, yaml.MappingNode):
            raise ConstructorError(None, None, "expected rows, cols, dt and data", node.start_mark)
        return self.construct_mapping(node, deep=True)


for _name in ("int", "float", "timestamp"):
    _Loader.add_constructor(f"tag:yaml.org,2002:{_name}", _Loader.construct_decimal)
for _name in ("opencv-matrix", "opencv-nd-matrix"):
    _Loader.add_constructor(f"tag:yaml.org,2002:{_name}", _Loader.construct_matrix)


def write_yaml(path: str | Path, content: dict[str, Any]) -> None:
    """Write keys with values in their order, lists on one line.

    Raises:
        OSError: if the file cannot be written.
    """
    text = yaml.safe_dump(content, sort_keys=False, default_flow_style=None, width=110)
    write_bytes(path, text.encode())
