# SPDX-License-Identifier: Apache-2.0
"""Command lines: file names are taken literally, mistakes are told in one paragraph."""

from __future__ import annotations

import io

import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser

from sphericalvision.recipes import predict
from sphericalvision.recipes.app import cli
from sphericalvision.recipes.app.cli import print_table, say, track
from sphericalvision.recipes.app.words import quote_paths, unquote_paths


@pytest.mark.parametrize(
    "path",
    [
        "a/cam{camera}/{frame:05d}.png",
        "epoch=1-step=2.ckpt",
        "it's here/x.yaml",
        "a,b [1](2).png",
        "back\\slash",
        "C:\\",
    ],
)
def test_file_names_reach_the_config_unchanged(path: str) -> None:
    (word,) = quote_paths([f"data.root={path}"])
    assert OverridesParser.create().parse_override(word).value() == path
    assert unquote_paths([word]) == [f"data.root={path}"]


@pytest.mark.parametrize("path", ["runs/[night]/x.png", "runs [/old]/x.png"])
def test_file_names_are_printed_unchanged(path: str, capsys: pytest.CaptureFixture[str]) -> None:
    say(f"  images={path}")
    assert f"  images={path}\n" in capsys.readouterr().out
    print_table("pictures", ["picture", "bytes"], [[path, "7"], ["x", "12345"]])
    rows = capsys.readouterr().out.splitlines()[4:6]
    assert rows == [f"│ {path} │     7 │", f"│ {'x':{len(path)}} │ 12345 │"]


def test_a_log_file_gets_lines_of_progress(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    clock = iter([0.0, *(10.0 * k for k in range(6))])  # an item takes 10 seconds
    monkeypatch.setattr(cli.time, "monotonic", lambda: next(clock))
    assert list(track(iter("abcdef"), "letters", 6)) == list("abcdef")
    lines = capsys.readouterr().out.splitlines()
    assert lines == ["letters: 2 of 6, 0:00:40 left", "letters: 4 of 6, 0:00:20 left"]


def test_words_that_are_no_file_names_stay() -> None:
    words = ["frames=[1,2]", "--config-dir=a", "resume=auto", "checkpoint=null", "masks='quoted'", "x"]
    assert quote_paths(words) == words


def test_a_terminal_without_the_letters_of_a_name_is_none_to_fail_on(monkeypatch: pytest.MonkeyPatch) -> None:
    terminal = io.TextIOWrapper(io.BytesIO(), encoding="ascii", write_through=True)
    monkeypatch.setattr("sys.stdout", terminal)
    predict.main(["--version"])
    print("output: caf\u00e9")
    assert terminal.buffer.getvalue().endswith(b"output: caf\\xe9\n")  # type: ignore[attr-defined]
