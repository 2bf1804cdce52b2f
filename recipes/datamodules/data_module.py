# SPDX-License-Identifier: Apache-2.0
"""Training data as one long, repeatable stream, and the loaders that every data module has."""

import multiprocessing
from collections import defaultdict
from collections.abc import Callable, Hashable, Iterator
from dataclasses import dataclass
from itertools import count, islice
from typing import Any, ClassVar, TypeAlias

import torch
from torch.utils.data import DataLoader, Dataset, Sampler

from sphericalvision.core import ArgumentError
from sphericalvision.data.collate import collate_samples
from sphericalvision.recipes.app.kinds import Count, Number

ENDLESS = 2**40
BATCHES_AHEAD = 3
"""Batches that each process prepares ahead: one large batch among small ones is not waited for at once."""

Sample = dict[str, Any]
Loader: TypeAlias = "DataLoader[Sample] | list[DataLoader[Sample]]"


class TrainingStream(Dataset[Sample]):
    """A data set shuffled again in every round, as one endless sequence whose order is known beforehand.

    What stands at a position, augmentation included, depends on the seed and the position alone: not on the
    number of workers, and not on whether training was interrupted before.

    Args:
        dataset: samples by index.
        seed: of the order and of torch's global generator while a sample is made.
    """

    def __init__(self, dataset: Dataset[Sample], seed: int = 0) -> None:
        self.dataset, self.seed = dataset, seed
        self._round = -1
        self._order: list[int] = []

    def index_at(self, position: int) -> int:
        """Index of the sample at a position."""
        size = len(self.dataset)  # type: ignore[arg-type]
        shuffle, offset = divmod(position, size)
        if shuffle != self._round:
            generator = torch.Generator().manual_seed(self.seed * 1_000_003 + shuffle)
            self._round, self._order = shuffle, torch.randperm(size, generator=generator).tolist()
        return self._order[offset]

    def __getitem__(self, position: int) -> Sample:
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed((self.seed + 1) * 1_000_000_007 + position)
            return self.dataset[self.index_at(position)]


class TrainingBatches(Sampler[list[int]]):
    """Positions of a training stream in batches of samples of one group, in an order that is known beforehand.

    Samples are taken in the order of the stream; each waits for the others of its group, and none is left out.

    Args:
        stream: whose positions they are.
        batch_size: samples in a batch; or what says it of a group.
        length: number of batches.
        group: of a sample, by its index in the data set; samples of one group can be stacked. One for all when not
            given.
        start: batches that all processes together have used up, when training resumes.
        rank: of the process, from 0.
        world: number of processes, which take batches in turns: together they take those of one process. What they take
            at the same time is of one group, so that none waits long for another.

    Examples:
        >>> stream = TrainingStream([{}] * 6)
        >>> list(TrainingBatches(stream, batch_size=2, length=3))
        [[0, 1], [2, 3], [4, 5]]
        >>> batches = TrainingBatches(stream, batch_size=2, length=20, group=lambda index: index % 2)
        >>> all(len({stream.index_at(position) % 2 for position in batch}) == 1 for batch in batches)
        True
    """

    def __init__(
        self,
        stream: TrainingStream,
        batch_size: int | Callable[[Any], int],
        length: int,
        group: Callable[[int], Hashable] | None = None,
        start: int = 0,
        rank: int = 0,
        world: int = 1,
    ) -> None:
        self.stream, self.batch_size, self.length = stream, batch_size, length
        self.group = group
        self.start, self.rank, self.world = start, rank, world

    def __len__(self) -> int:
        return self.length

    def __iter__(self) -> Iterator[list[int]]:
        first = self.start + self.rank
        return islice(self._batches(), first, first + self.length * self.world, self.world)

    def _batches(self) -> Iterator[list[int]]:
        """The batches of all processes from the first one on, as many of a group in a row as there are processes."""
        waiting: defaultdict[Hashable, list[int]] = defaultdict(list)
        in_a_row: defaultdict[Hashable, list[list[int]]] = defaultdict(list)
        size = self.batch_size
        for position in count():
            group = 0 if self.group is None else self.group(self.stream.index_at(position))
            waiting[group].append(position)
            if len(waiting[group]) == (size(group) if callable(size) else size):
                in_a_row[group].append(waiting.pop(group))
                if len(in_a_row[group]) == self.world:
                    yield from in_a_row.pop(group)


def _begin_worker(number: int) -> None:
    """Switch gradients off in a process that prepares samples."""
    torch.inference_mode().__enter__()


def even_batches(samples: int, batch_size: int, world: int) -> list[list[int]]:
    """Indices 0 to ``samples - 1`` in batches, each once and in order, as many batches for each of ``world`` processes.

    Processes wait for each other in every batch, so none may have one more. Where the last round would leave a process
    without a sample, earlier batches are larger by one or two.

    Raises:
        ArgumentError: there are fewer samples than processes.

    Examples:
        >>> even_batches(5, batch_size=1, world=2)
        [[0, 1], [2], [3], [4]]
        >>> even_batches(5, batch_size=2, world=2)
        [[0, 1], [2], [3], [4]]
    """
    if samples < world:
        raise ArgumentError(
            f"data: {samples} samples to validate or test with are too few for {world} processes; set "
            f"trainer.devices={samples} or take more samples"
        )
    rounds = min(-(-samples // (batch_size * world)), samples // world)
    return [batch.tolist() for batch in torch.arange(samples).tensor_split(rounds * world)]


@dataclass(eq=False, repr=False)
class SampleDataModule:
    """Loaders over data sets that subclasses make; ``dataset(split)`` is all they need to say.

    Fields of data modules are the keys of their files in ``conf/data``, which explain them. Lightning gets the loaders
    from :class:`~sphericalvision.recipes.training.loaders.Loaders`; evaluation does without it.
    """

    batch_size: Count = 4
    num_workers: Number = 0
    seed: int = 0

    of_training: ClassVar[tuple[str, ...]] = ("seed",)
    """Fields that the samples which ``sphericalvision-evaluate`` takes do not depend on."""
    has_truth: ClassVar[bool] = True
    """True if validation and test samples hold the true depth, so that ``sphericalvision-evaluate`` can use them."""

    def __post_init__(self) -> None:
        """Prepare what is no field; subclasses with an ``__init__`` of their own have it called by the base's."""

    def dataset(self, split: str) -> Dataset[Sample]:
        """Samples of "train", "val" or "test", on the icosphere; augmented in "train". Every subclass implements it."""
        raise NotImplementedError(f"{type(self).__name__}.dataset")

    def bind_network(self, net: Any, *more: str, depth_level: int | None = None) -> None:
        """Give samples that suit a network, with ``more`` entries; what the configuration says stays.

        Depth at vertices is on the network's grid unless ``depth_level`` says otherwise.
        """

    def plain_train_dataset(self) -> Dataset[Sample]:
        """The training samples without augmentation, in order."""
        return self.dataset("train")

    def group(self, index: int) -> Hashable:
        """The group of a training sample: only samples of one group share a batch. One for all here."""
        return 0

    @property
    def batch_sizes(self) -> int | Callable[[Any], int]:
        """Samples in a training batch, or what says it of a group."""
        return self.batch_size

    def left_out(self) -> list[str]:
        """Sentences about samples that were skipped, to be said at the end."""
        return []

    def render(self, split: str) -> None:
        """Make the samples of a split ready, with progress; data on disk are."""

    def prepare_data(self) -> None:
        """Write what training and validation will read, in one process, before any reads it."""

    def setup(self, stage: str) -> None:
        """Read what each process needs, with the network bound."""

    def train_dataloader(
        self, length: int = ENDLESS, start: int = 0, rank: int = 0, world: int = 1
    ) -> DataLoader[Sample]:
        """Training batches of a process; the arguments are those of :class:`TrainingBatches`."""
        stream = TrainingStream(self.dataset("train"), self.seed)
        batches = TrainingBatches(stream, self.batch_sizes, length, self.group, start, rank, world)
        return self.loader(stream, batches)

    def val_dataloader(self, rank: int = 0, world: int = 1) -> Loader:
        """Validation batches, in order; of several processes each gets its part."""
        return self.part_of_process(self.dataset("val"), rank, world)

    def test_dataloader(self, rank: int = 0, world: int = 1) -> Loader:
        """Test batches, in order; of several processes each gets its part."""
        return self.part_of_process(self.dataset("test"), rank, world)

    def part_of_process(self, dataset: Dataset[Sample], rank: int, world: int) -> DataLoader[Sample]:
        """Batches of one process; those of all processes together have each sample once."""
        if world == 1:
            return self.loader(dataset)
        size = self.ordered_batch_size
        return self.loader(dataset, even_batches(len(dataset), size, world)[rank::world])  # type: ignore[arg-type]

    @property
    def ordered_batch_size(self) -> int:
        """Samples in a batch of those that stay in order, for validation, tests and evaluation."""
        return self.batch_size

    def loader(
        self, dataset: Dataset[Sample], batches: TrainingBatches | list[list[int]] | None = None
    ) -> DataLoader[Sample]:
        """Batches of any data set of these samples, in order unless ``batches`` says which."""
        context = None
        if self.num_workers and torch.cuda.is_available():
            # A copy of a process that uses a GPU, and has other threads, may stop for good.
            context = multiprocessing.get_context("forkserver")
            context.set_forkserver_preload(["__main__", type(self).__module__])
        return DataLoader(
            dataset,
            batch_size=self.ordered_batch_size if batches is None else 1,
            batch_sampler=batches,
            num_workers=self.num_workers,
            collate_fn=collate_samples,
            persistent_workers=self.num_workers > 0,
            worker_init_fn=_begin_worker,
            prefetch_factor=BATCHES_AHEAD if self.num_workers else None,
            pin_memory=torch.cuda.is_available(),
            multiprocessing_context=context,
        )


@dataclass(eq=False, repr=False, kw_only=True)
class PreparedSamples(SampleDataModule):
    """Samples that each have their own rig, and whose images are preprocessed.

    Batches of training hold samples of as many cameras each; what is validated or tested comes one by one.
    """

    batch_size: Count = 1
    photometric: bool = True

    @property
    def ordered_batch_size(self) -> int:
        """1: in their order, samples of as many cameras each do not follow each other."""
        return 1
