# SPDX-License-Identifier: Apache-2.0
"""Batches for a device that is faster than what makes them: while none is ready, earlier ones again, changed anew."""

from __future__ import annotations

import queue
import random
import threading
from collections.abc import Callable, Iterable, Iterator
from typing import Any

from torch import Tensor

__all__ = ["ReusedBatches"]

Batch = dict[str, Any]

READY = 2
"""New batches that wait at most, beside those that wait in the loader itself."""
SPARE, LEAST_SPARE = 32, 6
"""Batches for another use that are kept at most, and at least: one of them is taken at random."""


class ReusedBatches:
    """The batches of a loader in their order, and between them earlier ones whenever the next is not ready in time.

    So a device never waits, but what it trains on depends on how fast samples are made.

    Args:
        loader: of new batches.
        uses: how often each batch is used at most, 2 or more.
        change: makes of a batch another one for its next use: a turn, a mirror image. It is called while a step of the
            training runs, so it draws from a generator of its own.
        pinned: whether tensors of changed batches are put where a GPU fetches them without waiting.
    """

    def __init__(
        self,
        loader: Iterable[Batch],
        uses: int,
        change: Callable[[Batch], Batch],
        pinned: bool = False,
    ) -> None:
        self.loader, self.uses, self.change, self.pinned = loader, uses, change, pinned
        #: Batches that were given out so far: new ones, and ones used again.
        self.new = self.again = 0

    def __iter__(self) -> Iterator[Batch]:
        ready: queue.Queue[Batch | BaseException | None] = queue.Queue(READY)
        spare: list[Batch] = []
        lock, ended = threading.Lock(), threading.Event()
        chance = random.Random(0)

        def hand_over(item: Batch | BaseException | None) -> None:
            while not ended.is_set():
                try:
                    ready.put(item, timeout=0.2)
                    return
                except queue.Full:
                    continue

        def fetch() -> None:
            try:
                for batch in self.loader:
                    hand_over(batch)
                    if ended.is_set():
                        return
                    for _ in range(1, self.uses):
                        changed = self._changed(batch)
                        with lock:
                            spare.append(changed)
                            del spare[:-SPARE]
                hand_over(None)
            except BaseException as error:  # raised again where batches are asked for
                hand_over(error)

        thread = threading.Thread(target=fetch, daemon=True, name="batches")
        thread.start()
        try:
            while True:
                try:
                    item = ready.get(block=len(spare) < LEAST_SPARE)
                except queue.Empty:
                    self.again += 1
                    with lock:
                        batch = spare.pop(chance.randrange(len(spare)))
                    yield batch
                    continue
                if item is None:
                    return
                if isinstance(item, BaseException):
                    raise item
                self.new += 1
                yield item
        finally:
            ended.set()
            thread.join(timeout=10)

    def _changed(self, batch: Batch) -> Batch:
        changed = self.change(batch)
        if not self.pinned:
            return changed
        return {
            key: value.pin_memory() if isinstance(value, Tensor) else value for key, value in changed.items()
        }
