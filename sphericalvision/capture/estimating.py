# SPDX-License-Identifier: Apache-2.0
"""Depth of frame after frame: some are read ahead, and on a CPU several are estimated side by side."""

from __future__ import annotations

import contextlib
import queue
import threading
import time
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, Literal, NamedTuple, TypeVar

import torch

from sphericalvision.capture.hints import CarriedDepth, Hint, with_hint
from sphericalvision.capture.predictor import Predictor, threads_kept
from sphericalvision.capture.result import Depth
from sphericalvision.capture.sources.frames import Frame, Selection, Source
from sphericalvision.core import ArgumentError, FileFormatError

MOST_WORKERS = 4
"""Frames that are estimated at once, each in memory of its own."""
BEFORE = 10
"""Frames whose depth counts in that of a later one, where it is carried on: what is older has faded to a third."""
WAIT = 0.1
"""Seconds after which a thread that waits looks whether its results are still needed."""

Item = TypeVar("Item")
Result = TypeVar("Result")


class Estimate(NamedTuple):
    """A frame and its depth.

    Attributes:
        frame: as it came.
        depth: None where the images could not be read, or the frame was not selected.
        seconds: that the network was busy, as a fraction of all that is estimated side by side.
    """

    frame: Frame
    depth: Depth | None
    seconds: float = 0.0


def estimate_frames(
    source: Source,
    selection: Selection,
    predictor: Predictor,
    selected: Callable[[str], bool] = lambda name: True,
    count: int | None = None,
    hints: Callable[[str], Hint] | Literal["last"] | None = None,
) -> Iterator[Estimate]:
    """Yield the depth of the selected frames in their order, while a thread reads the next ones.

    On a CPU as many frames as torch has threads, up to four, are estimated side by side; with the last frame as a hint
    one after the other, and up to ten frames that are not selected before each that is, too, so that a continuation
    starts from them.

    Args:
        source: of the frames.
        selection: which of them.
        predictor: of their depth.
        selected: asked by a frame's name before it is read, and again before it is estimated.
        count: of the frames, where that is known.
        hints: of a frame by its name; or ``"last"``: the depth of the frame before, where rigs move in one world.
    """
    last = _LastFrame(source.names(selection) or [], selected) if hints == "last" else None
    is_needed = selected if last is None else last.is_needed

    def estimate(frame: Frame) -> Estimate:
        if frame.images is None or not is_needed(frame.name):
            return Estimate(frame, None)
        start = time.perf_counter()
        used = predictor if frame.rig is None else predictor.with_changes(frame.rig)
        if last is not None:
            depth = last.averaged(frame.name, used(frame.images))
        elif callable(hints):
            try:
                depth = with_hint(used, frame.images, hints(frame.name))
            except (FileFormatError, OSError) as error:
                return Estimate(frame._replace(images=None, error=error), None)
            except ArgumentError as error:
                if not str(error).startswith("hint: "):
                    raise
                wrong = FileFormatError(f"frame {frame.name}, {error}")  # of this hint alone
                return Estimate(frame._replace(images=None, error=wrong), None)
        else:
            depth = used(frame.images)
        seconds = (time.perf_counter() - start) / workers
        return Estimate(frame, depth if selected(frame.name) else None, seconds)

    frames = ahead(source.frames(selection, is_needed), newest=source.live)
    with threads_kept() as threads:
        most = MOST_WORKERS if count is None else min(MOST_WORKERS, max(1, count))
        workers = min(threads, most) if predictor.device.type == "cpu" and last is None else 1
        with contextlib.closing(frames):
            if workers == 1:
                yield from map(estimate, frames)
            else:
                with contextlib.closing(
                    ordered_map(estimate, frames, workers, threads // workers)
                ) as results:
                    yield from results


class _LastFrame:
    """The depth of the frame before, carried on from frame to frame.

    Args:
        order: names of all frames.
        selected: whether the depth of a frame is asked for.
    """

    def __init__(self, order: list[str], selected: Callable[[str], bool]) -> None:
        self.order, self.selected = order, selected
        self.position = {name: position for position, name in enumerate(order)}
        self.before: tuple[int, CarriedDepth] | None = None

    def is_needed(self, name: str) -> bool:
        """Whether a frame or one of the next ten is selected."""
        start = self.position.get(name, 0)
        return any(map(self.selected, [name, *self.order[start + 1 : start + 1 + BEFORE]]))

    def averaged(self, name: str, depth: Depth) -> Depth:
        """The depth of a frame, averaged with that of the frame before unless that is long ago."""
        position = self.position.get(name, 0)
        if self.before is not None and position - self.before[0] <= BEFORE:
            depth = self.before[1].averaged(depth)
        self.before = position, Hint.of_depth(depth, torch.eye(4))
        return depth


def ahead(items: Iterable[Item], most: int = 3, newest: bool = False) -> Generator[Item, None, None]:
    """Yield items that a thread takes from an iterable while the caller works on earlier ones.

    An exception of the iterable is raised where its item would have come. The thread ends when the caller stops.

    Args:
        items: iterated in the thread.
        most: items that wait at once; the thread pauses beyond.
        newest: whether waiting items make room for newer ones in place of a pause, as of live cameras.

    Examples:
        >>> list(ahead(range(5), most=2))
        [0, 1, 2, 3, 4]
    """
    waiting: queue.Queue[tuple[str, Any]] = queue.Queue(most)
    ended = threading.Event()

    def put(kind: str, value: Any) -> None:
        while not ended.is_set():
            try:
                waiting.put((kind, value), timeout=WAIT)
                return
            except queue.Full:
                if newest and kind == "item":
                    with contextlib.suppress(queue.Empty):
                        waiting.get_nowait()

    def read() -> None:
        torch.set_num_threads(1)
        try:
            for item in items:
                put("item", item)
                if ended.is_set():
                    break
            put("end", None)
        except BaseException as error:
            put("error", error)
        finally:
            close = getattr(items, "close", None)
            if close is not None:
                close()

    thread = threading.Thread(target=read, name="reading ahead", daemon=True)
    thread.start()
    try:
        while True:
            kind, value = waiting.get()
            if kind == "end":
                return
            if kind == "error":
                raise value
            yield value
    finally:
        ended.set()
        thread.join()


def ordered_map(
    function: Callable[[Item], Result],
    items: Iterable[Item],
    workers: int,
    threads: int = 1,
    waiting: int = 0,
    finish: bool = False,
) -> Generator[Result, None, None]:
    """Yield a function's results for items, in their order, while threads work on the next ones.

    Two frames with a core each are done sooner than two frames, one after the other, with two cores: cores that work on
    one frame wait for each other hundreds of times. The first exception of the function is raised in its place.

    Args:
        function: called in the threads.
        items: iterated here, one more than there are workers, and as many more as may be ``waiting``.
        workers: calls at once.
        threads: that torch has in each.
        waiting: items that may wait for a worker while the iteration goes on.
        finish: whether items are worked on that wait when the iteration is interrupted, as by Ctrl+C; else they are
            dropped.

    Examples:
        >>> list(ordered_map(abs, [-3, 2, -1], workers=2))
        [3, 2, 1]
    """
    futures: deque[Future[Result]] = deque()
    pool = ThreadPoolExecutor(workers, "ordered map", torch.set_num_threads, (threads,))
    failed = False
    try:
        for item in items:
            futures.append(pool.submit(function, item))
            while len(futures) > workers + waiting or (futures and futures[0].done()):
                failed = futures[0].exception() is not None
                yield futures.popleft().result()
        while futures:
            failed = futures[0].exception() is not None
            yield futures.popleft().result()
    finally:
        pool.shutdown(cancel_futures=failed or not finish)
