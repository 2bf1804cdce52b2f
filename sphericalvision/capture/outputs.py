# SPDX-License-Identifier: Apache-2.0
"""Files that depth becomes: the writers of a run, frame after frame."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import torch

from sphericalvision.capture.checks import capture_warnings
from sphericalvision.capture.panoramas import Panoramas
from sphericalvision.capture.result import Depth
from sphericalvision.capture.result_folder import ResultFolder, Settings
from sphericalvision.capture.writers import OUTPUTS, WRITERS
from sphericalvision.core import check_choice


def save_frame(folder: Path, frame: str, views: Panoramas, settings: Settings) -> list[Path]:
    """Write the files of one frame, their names after that of the frame; returns the paths."""
    results = ResultFolder(folder, settings)
    return [path for name in settings.outputs for path in WRITERS[name](name, results).add(frame, views)]


class Outputs:
    """Writes frame after frame, and the files of all of them.

    Args:
        folder: of the results.
        settings: how.

    Attributes:
        results: the folder, and what its writers have in common.
        written: files so far.
        count: frames so far.
        warnings: what is probably wrong, by the first frame.

    Raises:
        ArgumentError: an unknown output.
        FileFormatError: results that are to be continued cannot be read.
    """

    def __init__(self, folder: Path, settings: Settings) -> None:
        for output in settings.outputs:
            check_choice("outputs", output, OUTPUTS)
        self.results = ResultFolder(folder, settings)
        self._writers = [WRITERS[name](name, self.results) for name in OUTPUTS if name in settings.outputs]
        self.written: list[Path] = []
        self.count = 0
        self.warnings: list[str] = []

    def has(self, frame: str) -> bool:
        """Whether every output has this frame, in files that are there whole."""
        return self.results.settings.go_on and all(writer.has(frame) for writer in self._writers)

    def remaining(self, frames: Sequence[str]) -> set[str]:
        """Those of the frames that an output lacks; all of them where one is lacking that cannot be continued."""
        missing = {frame for frame in frames if not self.has(frame)}
        restarts = any(writer.restarts for writer in self._writers)
        return set(frames) if missing and restarts else missing

    def write(self, frame: str, depth: Depth) -> None:
        """Write the files of a frame, and add it to those of all."""
        with torch.inference_mode():
            if not self.count:
                self.warnings += capture_warnings(depth)
            self.count += 1
            views = self.results.views(Panoramas(depth, self.results.settings.height, self.results.near))
            for writer in self._writers:
                self.written += writer.add(frame, views)

    def close(self) -> None:
        """Finish the files of all frames."""
        for writer in self._writers:
            self.written += writer.close()

    def described(self) -> list[str]:
        """Sentences about all frames together, warnings last."""
        sentences = [sentence for writer in self._writers for sentence in writer.described()]
        return [*dict.fromkeys(sentences), *(f"Warning: {warning}" for warning in self.warnings)]
