# SPDX-License-Identifier: Apache-2.0
"""The programs of pages, run by other processes while MkDocs writes the pages that have none.

A page whose program raises is run once more, by markdown-exec, which says where.
"""

from __future__ import annotations

import io
import multiprocessing
import os
import re
import signal
import sys
import tempfile
from collections import defaultdict
from concurrent.futures import Future, ProcessPoolExecutor
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any

import torch
from markdown_exec import base_format, formatters

PROGRAM = re.compile(
    r'^```python ([^\n]*exec="true"[^\n]*)\n(.*?)^```$', re.DOTALL | re.MULTILINE
)
STARTED: dict[str, Future[dict[tuple[str, str], str]]] = {}
"""Address of a page -> what its programs print, by session and code, some time later."""
PRINTED: dict[tuple[str, str], str] = {}
"""The same of all pages that are done."""
run_now = formatters["python"]


def outputs(text: str) -> dict[tuple[str, str], str]:
    """Run the programs of a page in an empty folder, and return what they print; nothing, if one of them raises."""
    torch.manual_seed(0)  # whatever page this process had before
    os.chdir(tempfile.mkdtemp())
    sys.modules["page"] = ModuleType("page")  # dataclasses look there
    sessions: dict[str, dict[str, Any]] = defaultdict(dict)
    result = {}
    for options, code in PROGRAM.findall(text):
        match = re.search(r'session="([^"]+)"', options)
        session, printed = match[1] if match else "", io.StringIO()
        names = sessions[session] if session else {}
        names |= {"__name__": "page", "print": partial(print, file=printed)}
        try:
            exec(compile(code, "page", "exec"), names)
        except Exception:
            return {}
        result[session, code.strip()] = printed.getvalue()
    return result


def begin_process() -> None:
    """Each core has a page; Ctrl-C ends them all."""
    torch.set_num_threads(1)
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def start(files: Any) -> None:
    """Begin with the programs of the pages, in the order in which MkDocs reads them."""
    texts = {
        file.src_uri: text
        for file in files.documentation_pages()
        if PROGRAM.search(text := Path(file.abs_src_path).read_text())
    }
    PRINTED.clear()
    if texts:
        pool = ProcessPoolExecutor(
            min(4, os.cpu_count() or 1, len(texts)),
            multiprocessing.get_context(
                "fork" if sys.platform == "linux" else "spawn"
            ),
            begin_process,
        )
        for page, text in texts.items():
            STARTED[page] = pool.submit(outputs, text)
        pool.shutdown(wait=False)
        formatters["python"] = formatted


def stop() -> None:
    """Begin with no other page."""
    for future in STARTED.values():
        future.cancel()


def wait_for(page: str) -> None:
    """Until the programs of a page have run."""
    if page in STARTED:
        PRINTED.update(STARTED.pop(page).result())


def formatted(*, code: str, session: str = "", **options: Any) -> str:
    """What a program has printed, as markdown-exec puts it into a page."""
    printed = PRINTED.get((session, code.strip()))
    if printed is None:
        return run_now(code=code, session=session, **options)
    return base_format(
        language="python",
        run=lambda *_, **__: printed,
        code=code,
        session=session,
        **options,
    )
