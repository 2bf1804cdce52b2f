# SPDX-License-Identifier: Apache-2.0
"""YAML from strangers: bounded, one document, nothing run; numbers as people mean them."""

import time
from pathlib import Path

import pytest

from sphericalvision.core import FileFormatError
from sphericalvision.io.yaml_files import MAX_VALUES, parse_yaml, read_yaml, write_yaml

LEVELS = "".join(f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 10)}]\n" for k in range(1, 9))

REFUSED = {
    "aliases": f"a0: &a0 [x, x]\n{LEVELS}",
    "merges": "a0: &a0 {x: 1}\n"
    + "".join(f"a{k}: &a{k} {{<<: [{', '.join([f'*a{k - 1}'] * 10)}], k{k}: 1}}\n" for k in range(1, 9)),
    "itself": "a: &a [1, *a]\n",
    "itself as a key's value": "a: &a {b: *a}\n",
    "depth": "[" * 100_000,
    "key twice": "a: 1\nb: 2\na: 3\n",
    "JSON lines": '{"a": 1}\n{"a": 2}\n',
    "documents that differ": "a: 1\n---\na: 2\n",
    "code": "a: !!python/object/apply:os.system ['exit 1']\n",
    "digits": f"a: {'9' * 5000}\n",
    "open": "a: [1, 2\n",
}


@pytest.mark.parametrize("name", REFUSED)
def test_is_refused_at_once_and_in_short(name: str, tmp_path: Path) -> None:
    path = tmp_path / "stranger.yaml"
    path.write_text(REFUSED[name])
    start = time.process_time()
    with pytest.raises(FileFormatError) as caught:
        read_yaml(path)
    assert str(path) in str(caught.value)
    assert len(str(caught.value)) < 600 + len(str(path))
    assert time.process_time() - start < 2


def test_values_count_as_often_as_they_are_referred_to() -> None:
    thousand = f"a: &a [{'1, ' * 999}1]\n"
    below = MAX_VALUES // 1001 - 2
    assert len(parse_yaml(f"{thousand}b: [{'*a, ' * below}]\n", "x")["b"]) == below
    with pytest.raises(FileFormatError):
        parse_yaml(f"{thousand}b: [{'*a, ' * (below + 2)}]\n", "x")


def test_documents_that_differ_in_their_headers_are_one() -> None:
    first, second = (f"header:\n  stamp: {{sec: {second}}}\nd: [1, 2]\n" for second in (1, 2))
    assert parse_yaml(f"# a topic\n{first}---\n{second}---\n", "x")["header"]["stamp"]["sec"] == 1


def test_the_line_of_an_error_is_that_of_the_file() -> None:
    with pytest.raises(FileFormatError, match="line 4"):
        parse_yaml("# one\n---\na: 1\na: 2\n", "x")


def test_numbers_are_those_that_people_mean() -> None:
    text = "a: 010\nb: 1:30\nc: 2024-02-31\nd: -0.5\ne: 1.0e-5\nf: 0\ng: true\nh: null\n"
    content = parse_yaml(text, "x")
    expected = ["010", "1:30", "2024-02-31", -0.5, 1e-5, 0, True, None]
    assert list(content.values()) == expected


def test_what_is_written_is_read(tmp_path: Path) -> None:
    content = {"b": [1, 2.5, "cam1 é"], "a": {"nested": [True, None]}}
    write_yaml(tmp_path / "a.yaml", content)
    assert read_yaml(tmp_path / "a.yaml") == content
    assert list(read_yaml(tmp_path / "a.yaml")) == ["b", "a"]
