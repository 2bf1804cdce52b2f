# SPDX-License-Identifier: Apache-2.0
"""Results of sweep and prior for samples, computed once and kept: half the cost of a training step."""

from hashlib import sha256
from pathlib import Path

import torch
from torch import Tensor
from torch.utils.data import Dataset

from sphericalvision import __version__
from sphericalvision.core import ArgumentError
from sphericalvision.icosphere import num_icosphere_vertices
from sphericalvision.models import DepthNetwork, IcoSweepNet, RefinedSweepNet
from sphericalvision.models.hint_gate import SweepClues
from sphericalvision.models.weights.checkpoints import read_network
from sphericalvision.models.weights.files import identity_of
from sphericalvision.recipes.datamodules.data_module import Sample
from sphericalvision.scenes import WorldSamples
from sphericalvision.scenes.cache import ArrayCache, Kept
from sphericalvision.scenes.samples import images_as_floats


def prior_of(weights: str | Path) -> IcoSweepNet:
    """Return the prior in a file of weights: an ``IcoSweepNet``, or that of a ``RefinedSweepNet``.

    Raises:
        MissingFileError: there is no such file.
        ArgumentError: it holds another network.
    """
    net = read_network(weights)
    prior = net.prior if isinstance(net, RefinedSweepNet) else net
    if not isinstance(prior, IcoSweepNet):
        raise ArgumentError(
            f"data.clues: {weights} is {type(net).__name__}; expected an IcoSweepNet, which is the prior, or a "
            "RefinedSweepNet, which has one"
        )
    return prior


def clues_of(batch: Sample) -> SweepClues:
    """The clues of a batch, as the network computes with them."""
    return SweepClues(**{name: values.float() for name, values in batch["clues"].items()})


def clue_shapes(hypotheses: int, coarse_level: int) -> dict[str, tuple[int, int]]:
    """Shapes of the fields of ``SweepClues`` of a sample."""
    vertices = num_icosphere_vertices(coarse_level)
    return {
        "cost": (2 * hypotheses - 1, vertices),
        "best": (2 * hypotheses - 1, vertices),
        "mean": (hypotheses, vertices),
        "cameras": (4, vertices),
        "prior": (hypotheses, num_icosphere_vertices(coarse_level - 1)),
    }


def clue_bytes(net: DepthNetwork, level: int) -> int:
    """Size of the clues of a sample with images of a level, as they are kept."""
    sizes = net.hyperparameters
    coarse_level = level - 1 if sizes["coarse_level"] is None else min(sizes["coarse_level"], level - 1)
    shapes = clue_shapes(sizes["inner_hypotheses"], coarse_level)
    return sum(2 * rows * columns for rows, columns in shapes.values())


class SamplesWithClues(Dataset[Sample]):
    """Samples of a world with an entry ``clues``: the fields of ``SweepClues`` of their images, in half precision.

    Args:
        samples: with images as bytes.
        net: that the clues are for, at any level.
        prior: which they are of, in place of the network's own.
        folder: where they are kept.
    """

    def __init__(
        self, samples: WorldSamples, net: DepthNetwork, prior: IcoSweepNet, folder: str | Path
    ) -> None:
        if not isinstance(net, RefinedSweepNet):
            raise ArgumentError(
                f"data.clues: expected null for {type(net).__name__}, which starts from no clues"
            )
        level = samples.view.level
        assert level is not None
        self.samples = samples
        # A network of its own, without those large parts that clues need not.
        sizes = {
            name: net.hyperparameters[name] for name in ("min_depth", "inner_hypotheses", "coarse_level")
        }
        self.net = RefinedSweepNet.around(prior, level=level, widths=(2, 2), blocks=1, **sizes).eval()
        content = (__version__, samples.fingerprint, identity_of(self.net.prior), self.net.coarse_level)
        name = f"clues-{sha256(repr(content).encode()).hexdigest()[:16]}"
        shapes = clue_shapes(self.net.inner_hypotheses, self.net.coarse_level)
        entries: dict[str, Kept] = {name: (shape, torch.float16) for name, shape in shapes.items()}
        self.cache = ArrayCache(Path(folder) / name, entries, compress=False)

    def __len__(self) -> int:
        return len(self.samples)

    def __getitem__(self, index: int) -> Sample:
        sample = self.samples[index]
        return {**sample, "clues": self.cache.get(sample["frame"], lambda: self._computed(sample))}

    def is_cached(self, index: int) -> bool:
        """Tell whether sample and clues are in the cache."""
        return self.samples.is_cached(index) and self.cache.has(self.samples.name(index))

    @torch.inference_mode()
    def _computed(self, sample: Sample) -> dict[str, Tensor]:
        seen = sample["seen"][None]
        images = images_as_floats(sample["images"][None], seen)
        images, seen = self.net.views(images, seen)[0]
        clues = self.net.clues(images, self.net.tables(sample["rig"]), seen)
        return {name: values[0].half().clone() for name, values in clues._asdict().items()}
