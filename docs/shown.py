# SPDX-License-Identifier: Apache-2.0
"""What the pages' own code uses, and no reader needs: example files, and pictures inside the page.

MkDocs loads this file as a hook, which makes it importable from the pages as ``shown``.
"""

from __future__ import annotations

import base64
import sys
import tempfile
from pathlib import Path

import cv2
import numpy as np

sys.path.append(str(Path(__file__).parent))
_FOLDERS: list[tempfile.TemporaryDirectory[str]] = []  # kept until the end of the process


def example(**files: str) -> Path:
    """A fresh folder with these files; ``__`` in a name stands for its dot."""
    _FOLDERS.append(tempfile.TemporaryDirectory())
    folder = Path(_FOLDERS[-1].name)
    for name, text in files.items():
        (folder / name.replace("__", ".")).write_text(text)
    return folder


def show(picture: np.ndarray) -> None:
    """Print an RGB picture (h, w, 3) as HTML."""
    data = base64.b64encode(cv2.imencode(".png", picture[..., ::-1])[1]).decode()
    print(f'<img class="picture" alt="" src="data:image/png;base64,{data}">')
