# SPDX-License-Identifier: Apache-2.0
"""What the pages' own code uses, and no reader needs: example files, and pictures inside the page.

MkDocs loads this file as a hook; ``on_config`` then makes it importable from the pages as ``shown``.
"""

from __future__ import annotations

import base64
import sys
import tempfile
from pathlib import Path

import cv2
import numpy as np

_FOLDERS: list[tempfile.TemporaryDirectory[str]] = []  # kept until the end of the process


def on_config(config: object) -> None:
    """What MkDocs calls once it is configured."""
    sys.path.append(str(Path(__file__).parent))


def example(**files: str) -> Path:
    """A fresh folder with these files; ``__`` in a name stands for its dot."""
    _FOLDERS.append(tempfile.TemporaryDirectory())
    folder = Path(_FOLDERS[-1].name)
    for name, text in files.items():
        (folder / name.replace("__", ".")).write_text(text)
    return folder


def source(path: str, language: str = "yaml") -> str:
    """A file of this project as a block of code, titled with its name."""
    text = (
        (Path(__file__).parents[1] / path).read_text().removeprefix("# SPDX-License-Identifier: Apache-2.0\n")
    )
    name = path.removeprefix("tests/plugin/")
    return f'```{language} title="{name}"\n{text}```\n'


def picture(pixels: np.ndarray) -> str:
    """An RGB picture (h, w, 3) as HTML; the page's own ``print`` is what markdown-exec collects."""
    data = base64.b64encode(cv2.imencode(".png", pixels[..., ::-1])[1]).decode()
    return f'<img class="picture" alt="" src="data:image/png;base64,{data}">'
