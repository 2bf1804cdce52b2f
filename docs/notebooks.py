# SPDX-License-Identifier: Apache-2.0
"""The tutorials as Jupyter notebooks.

Run as ``python docs/notebooks.py FOLDER``, or ``make notebooks``. The pages are the source; jupytext reads their blocks
as cells.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path
from typing import Any

import jupytext

TUTORIALS = Path(__file__).parent / "tutorials"
#: In a notebook a picture is shown by IPython, not printed into a page.
SHOWN = """import cv2
from IPython.display import Image, display


def html(picture, alt):
    if not hasattr(picture, "shape"):
        return picture  # a figure
    return Image(cv2.imencode(".png", picture[..., ::-1])[1].tobytes(), alt=alt)


"""
#: Pages show files of the project, which a notebook names.
SOURCE = """def source(path, language):
    return f"{path} of the project's repository"


"""


def notebook(page: Path) -> Any:
    """A page of the tutorials as a notebook."""
    text = page.read_text()
    text = re.sub(r"^```python [^\n]*$", "```python", text, flags=re.M)
    # Command lines are to be read, not run.
    text = re.sub(
        r"^```bash\n(.*?)^```$", r"~~~bash\n\1~~~", text, flags=re.M | re.S
    )
    # Links to other pages lead nowhere from here: their words stay.
    text = re.sub(
        r"\[([^\]\n]*(?:\n[^\]\n]*)?)\]\((?!https?:)[^)\s]*\)", r"\1", text
    )
    text = text.replace("from shown import source\n", SOURCE)
    # The viewer is a file, which a notebook has written, too.
    text = re.sub(
        r"^.*\bembedded\b.*# markdown-exec: hide.*\n",
        "",
        text,
        flags=re.M,
    )
    text = re.sub(r" *# markdown-exec: hide.*$", "", text, flags=re.M)
    text = text.replace("from shown import html\n", SHOWN).replace(
        "print(html(", "display(html("
    )
    made = jupytext.reads(text, fmt="md")
    made.metadata["kernelspec"] = {
        "display_name": "Python 3",
        "language": "python",
        "name": "python3",
    }
    return made


def main(folder: str) -> None:
    """Write all of them."""
    target = Path(folder)
    target.mkdir(parents=True, exist_ok=True)
    for page in sorted(TUTORIALS.glob("*.md")):
        path = target / f"{page.stem}.ipynb"
        jupytext.write(notebook(page), path)
        print(path)


if __name__ == "__main__":
    main(sys.argv[1] if len(sys.argv) > 1 else "notebooks")
