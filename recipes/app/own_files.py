# SPDX-License-Identifier: Apache-2.0
"""Python files in a folder of one's own configs (``--config-dir``): networks, cameras, losses without a package."""

import importlib
import os
import sys
from pathlib import Path

from sphericalvision.core import ArgumentError


def import_own_files(folder: str | Path) -> None:
    """Import the Python files in a folder, so that what they register is known and ``_target_`` can name the rest.

    Processes that are started later find them, too.

    Raises:
        ArgumentError: a file has the name of an installed module, or cannot be imported.
    """
    folder = Path(folder).absolute()
    files = sorted(path for path in folder.glob("*.py") if path.stem != "__init__")
    if not files:
        return
    if str(folder) not in sys.path:
        sys.path.append(str(folder))
        os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, [os.environ.get("PYTHONPATH"), str(folder)]))
    importlib.invalidate_caches()
    for path in files:
        try:
            module = importlib.import_module(path.stem)
        except Exception as error:  # whatever is wrong in a file of somebody's own
            raise ArgumentError(f"{path}: cannot be imported ({type(error).__name__}: {error})") from error
        if module.__file__ is None or Path(module.__file__).resolve() != path.resolve():
            raise ArgumentError(
                f"{path}: {path.stem} is a module already ({module.__file__}); rename the file"
            )
