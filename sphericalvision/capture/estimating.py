# SPDX-License-Identifier: Apache-2.0
"""Depth of frame after frame: some are read ahead, on a CPU several are estimated side by side, and written behind."""

from __future__ import annotations

import contextlib
import queue
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, Generic, Literal, NamedTuple, TypeVar

import torch

from sphericalvision.capture.hints import CarriedDepth, Hint
from sphericalvision.capture.predictor import Predictor
from sphericalvision.capture.result import Depth
from sphericalvision.capture.sources.frames import Frame, Selection, Source
from sphericalvision.core import ArgumentError, FileFormatError

__all__ = ["Behind", "Estimate", "ahead", "estimate_frames", "side_by_side", "threads_kept"]

MOST_WORKERS = 4
"""Frames that are estimated at once, each in memory of its own."""
BEFORE = 10
"""Frames whose depth counts in that of a later one, where it is carried on: what is older has faded to a third."""
WAIT = 0.1
"""Seconds after which a thread that waits looks whether it is still wanted."""

Item = TypeVar("Item")
Result = TypeVar("Result")


class Estimate(NamedTuple):
    """A frame and its depth.

    Attributes:
        frame: as it came.
        depth: None where the images could not be read, or nobody wants it any more.
        seconds: that the network was busy, as a share of all that is estimated side by side.
    """

    frame: Frame
    depth: Depth | None
    seconds: float = 0.0


def estimate_frames(
    source: Source,
    selection: Selection,
    predictor: Predictor,
    selected: Callable[[str], bool] = lambda name: True,
    number: int | None = None,
    hints: Callable[[str], Hint] | Literal["last"] | None = None,
) -> Iterator[Estimate]:
    """Yield the depth of the selected frames in their order, while a thread reads the next ones.

    On a CPU as many frames as torch has threads, up to four, are estimated side by side; with the last frame as a hint
    one after the other, and up to ten frames that are not selected before each that is, too, so that a continuation
    goes on with them.

    Args:
        source: of the frames.
        selection: which of them.
        predictor: of their depth.
        selected: asked by a frame's name before it is read, and again before it is estimated.
        number: of the frames, where that is known.
        hints: of a frame by its name; or ``"last"``: the depth of the frame before, where rigs move in one world.
    """
    order = (source.names(selection) or []) if hints == "last" else []
    places = {name: place for place, name in enumerate(order)}
    last: tuple[int, CarriedDepth | None] = (0, None)

    def is_needed(name: str) -> bool:
        after = places.get(name, 0) + 1
        return selected(name) or any(map(selected, order[after : after + BEFORE]))

    def estimate(frame: Frame) -> Estimate:
        nonlocal last
        if frame.images is None or not is_needed(frame.name):
            return Estimate(frame, None)
        start = time.perf_counter()
        place = places.get(frame.name, 0)
        try:
            hint = hints(frame.name) if callable(hints) else last[1] if place - last[0] <= BEFORE else None
        except (FileFormatError, OSError) as error:
            return Estimate(frame._replace(images=None, error=error), None)
        try:
            depth = (predictor if frame.rig is None else predictor.with_changes(frame.rig))(
                frame.images, hint
            )
        except ArgumentError as error:
            if not callable(hints) or not str(error).startswith("hint: "):
                raise
            wrong = FileFormatError(f"frame {frame.name}, {error}")  # of this hint alone
            return Estimate(frame._replace(images=None, error=wrong), None)
        if hints == "last":
            last = place, Hint.of_depth(depth, torch.eye(4))
        return Estimate(
            frame, depth if selected(frame.name) else None, (time.perf_counter() - start) / workers
        )

    frames = ahead(source.frames(selection, is_needed), newest=source.live)
    with threads_kept() as threads:
        most = MOST_WORKERS if number is None else min(MOST_WORKERS, max(1, number))
        workers = min(threads, most) if predictor.device.type == "cpu" and hints != "last" else 1
        estimated = side_by_side(estimate, frames, workers, threads // workers)
        try:
            yield from estimated
        finally:
            estimated.close()  # type: ignore[attr-defined]
            frames.close()  # type: ignore[attr-defined]


def ahead(items: Iterable[Item], most: int = 3, newest: bool = False) -> Iterator[Item]:
    """Yield items that a thread takes from an iterable while the caller works on earlier ones.

    An exception of the iterable is raised where its item would have come. The thread ends when the caller stops.

    Args:
        items: iterated in the thread.
        most: items that wait at once; the thread pauses beyond.
        newest: whether items that nobody has taken make room for newer ones in place of a pause, as of live cameras.

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
                    _drop_one(waiting)

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


def side_by_side(
    function: Callable[[Item], Result], items: Iterable[Item], workers: int, threads: int = 1
) -> Iterator[Result]:
    """Yield what a function makes of items, in their order, while it works on the next ones in threads.

    Two frames with a core each are done sooner than two frames, one after the other, with two cores: cores that share
    a frame wait for each other hundreds of times.

    Args:
        function: called in the threads; here, if there is one worker.
        items: taken as they are needed, one more than there are workers.
        workers: calls at once.
        threads: that torch has in each.

    Examples:
        >>> list(side_by_side(abs, [-3, 2, -1], workers=2))
        [3, 2, 1]
    """
    if workers == 1:
        yield from map(function, items)
        return
    waiting: deque[Future[Result]] = deque()
    pool = ThreadPoolExecutor(workers, "side by side", torch.set_num_threads, (threads,))
    try:
        for item in items:
            waiting.append(pool.submit(function, item))
            while len(waiting) > workers or (waiting and waiting[0].done()):
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()
    finally:
        pool.shutdown(cancel_futures=True)


@contextlib.contextmanager
def threads_kept() -> Iterator[int]:
    """Give back to torch the number of threads that it has here, whatever threads within ask for; yields it."""
    number = torch.get_num_threads()
    try:
        yield number
    finally:
        torch.set_num_threads(number)


def _drop_one(waiting: queue.Queue[Any]) -> None:
    with contextlib.suppress(queue.Empty):
        waiting.get_nowait()


class Behind(Generic[Item]):
    """Calls a function with items one after the other, in a thread, while the caller goes on.

    As a context: leaving it waits until all is done. The first exception of the function is raised at the next ``put``
    or at the end; what waits behind it is not done.

    Args:
        function: called with each item.
        most: items that wait at once; ``put`` waits beyond.

    Examples:
        >>> done = []
        >>> with Behind(done.append, most=2) as behind:
        ...     for number in range(4):
        ...         behind.put(number)
        >>> done
        [0, 1, 2, 3]
    """

    def __init__(self, function: Callable[[Item], Any], most: int = 3) -> None:
        self._function = function
        self._waiting: queue.Queue[tuple[bool, Any]] = queue.Queue(most)
        self._error: BaseException | None = None
        self._thread = threading.Thread(target=self._work, name="writing behind", daemon=True)

    def __enter__(self) -> Behind[Item]:
        self._thread.start()
        return self

    def put(self, item: Item) -> None:
        """Have the function called with ``item``; waits while too many do already."""
        self._raise()
        self._waiting.put((True, item))

    def __exit__(self, kind: Any, *_: Any) -> None:
        self._waiting.put((False, None))
        self._thread.join()
        if kind is None:
            self._raise()

    def _work(self) -> None:
        torch.set_num_threads(1)  # more would stand in the way of the network
        while True:
            more, item = self._waiting.get()
            if not more:
                return
            if self._error is None:
                try:
                    self._function(item)
                except BaseException as error:
                    self._error = error

    def _raise(self) -> None:
        if self._error is not None:
            raise self._error
