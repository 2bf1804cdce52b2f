# SPDX-License-Identifier: Apache-2.0
"""``WorldSamples``: what seeds stand for in a world as samples for networks, kept in a folder."""

from __future__ import annotations

import os
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor
from torch.utils.data import Dataset

from sphericalvision.cameras import CameraRig
from sphericalvision.core import ArgumentError
from sphericalvision.data.sample_view import SampleView, ToView
from sphericalvision.icosphere import Icosphere
from sphericalvision.scenes.cache import ArrayCache, Kept, decode, encode
from sphericalvision.scenes.world import HELD_OUT_SEED, World, WorldFrame
from sphericalvision.sphere import Equirectangular, SphereGrid
from sphericalvision.sphere.intake import signed, unsigned


class WorldSamples(Dataset[dict[str, Any]]):
    """What seeds stand for in a world, each rendered when it is first asked for.

    Args:
        world: of which samples are made.
        view: what they hold, see ``SampleView``; depth is exact along the rays.
        seeds: of samples 0, 1, ...; disjoint seeds are disjoint data. Below 10,000,000, which are for comparing
            methods.
        cache_dir: folder where samples are kept, images as bytes; shared by any number of processes, and by data
            sets of any worlds and views. Rendered each time when not given.
        as_bytes: whether images are left as bytes, a quarter of what has to be moved, for ``images_as_floats``.

    Returns:
        Samples with the entries of the view, the ``rig`` as its calibration has it, and ``frame``, kind and seed. Depth
        is ``valid`` from ``world.min_depth`` on. Where a world draws rigs their numbers of cameras differ: a batch
        takes samples of as many each.

    Raises:
        ArgumentError: seeds out of range, or cameras farther from the rig's centre than the space that scenes keep
            free.
        ShapeError: the cameras' own images are wanted, and differ in size.

    Examples:
        >>> from sphericalvision.cameras import ring_rig
        >>> world = World(ring_rig(2, image_size=(24, 24)))
        >>> sample = WorldSamples(world, SampleView(level=3, depth_level=1), range(100))[0]
        >>> {key: tuple(value.shape) for key, value in sample.items() if isinstance(value, torch.Tensor)}
        {'images': (2, 3, 642), 'seen': (2, 642), 'inverse_depth': (42,), 'valid': (42,)}
        >>> sorted(WorldSamples(world, SampleView(images=True, panorama=(8, 16)), range(1))[0])
        ['fisheye', 'fisheye_seen', 'frame', 'panorama_inverse_depth', 'panorama_valid', 'rig']
    """

    def __init__(
        self,
        world: World,
        view: SampleView,
        seeds: range,
        cache_dir: str | os.PathLike[str] | None = None,
        as_bytes: bool = False,
    ) -> None:
        if not seeds or min(seeds) < 0 or max(seeds) >= HELD_OUT_SEED:
            raise ArgumentError(
                f"seeds: expected one or more from 0 to {HELD_OUT_SEED - 1}, got {seeds}; seeds from {HELD_OUT_SEED} "
                "are held out for the benchmark"
            )
        if isinstance(world.rig, CameraRig):
            world.check_free_space(world.rig)
        self.world, self.view, self.seeds, self.as_bytes = world, view, seeds, as_bytes
        self.to_view = ToView(view)
        #: Sixteen characters that change with everything but the seeds.
        self.fingerprint = world.fingerprint(view)
        folder = None if cache_dir is None else Path(cache_dir) / f"samples-{self.fingerprint}"
        depths = {key: (grid().shape, torch.float32) for key, grid in self._grids.items()}
        self.cache = ArrayCache(folder, _images_of(view, world.rig) | depths)

    def __len__(self) -> int:
        return len(self.seeds)

    def __getitem__(self, index: int) -> dict[str, Any]:
        if not -len(self) <= index < len(self):
            raise IndexError(f"index {index} is outside a data set of {len(self)} scenes")
        frame = self.world.frame(self.seeds[index])
        sample: dict[str, Any] = self.cache.get(frame.name, lambda: self._rendered(frame))
        for key, seen in (("images", "seen"), ("fisheye", "fisheye_seen")):
            if key in sample and not self.as_bytes:
                sample[key] = signed(decode(sample[key]), sample[seen])
        for key in self._grids:
            sample[key.replace("inverse_depth", "valid")] = sample[key] <= 1 / self.world.min_depth
        return {**sample, "rig": frame.posed_rig, "frame": frame.name}

    def is_cached(self, index: int) -> bool:
        """Whether what was rendered for a sample lies in the cache; never without one."""
        return self.cache.has(self.name(index))

    def name(self, index: int) -> str:
        """The entry ``frame`` of a sample, kind and seed, by which it is kept."""
        return self.world.frame(self.seeds[index]).name

    @property
    def _grids(self) -> dict[str, Callable[[], SphereGrid]]:
        """By entry, what makes the grid with depth: tables of a grid need not go to the processes of a loader."""
        grids: dict[str, Callable[[], SphereGrid]] = {}
        if self.view.depth_level is not None:
            grids["inverse_depth"] = partial(Icosphere, self.view.depth_level)
        if self.view.panorama is not None:
            grids["panorama_inverse_depth"] = partial(Equirectangular.with_square_pixels, *self.view.panorama)
        return grids

    def _rendered(self, frame: WorldFrame) -> dict[str, Tensor]:
        """The arrays of a sample that are kept."""
        arrays: dict[str, Tensor] = {}
        if self.view.level is not None or self.view.images:
            entries = self.to_view.images(frame.images, frame.rig)
            arrays = {
                key: values if key.endswith("seen") else encode(unsigned(values))
                for key, values in entries.items()
            }
        return arrays | {key: frame.inverse_depth(grid().directions) for key, grid in self._grids.items()}


def images_as_floats(
    images: UInt8[Tensor, "B n 3 *size"], seen: Bool[Tensor, "B n *size"]
) -> Float[Tensor, "B n 3 *size"]:
    """Return a batch of images that were left as bytes in [-1, 1], 0 where not seen.

    Examples:
        >>> images = torch.tensor([0, 255], dtype=torch.uint8).expand(1, 1, 3, 2)
        >>> images_as_floats(images, torch.tensor([[[True, False]]]))[0, 0]
        tensor([[-1.,  0.],
                [-1.,  0.],
                [-1.,  0.]])
    """
    return signed(decode(images).flatten(0, 1), seen.flatten(0, 1)).view(images.shape)


def _images_of(view: SampleView, rig: Any) -> dict[str, Kept]:
    """Shapes and types of the images of a sample; None stands for what the seed decides."""
    number, size = None, (None, None)
    if isinstance(rig, CameraRig):
        number, size = len(rig), next(iter(rig.cameras.values())).image_size  # type: ignore[assignment]
    arrays: dict[str, Kept] = {}
    if view.level is not None:
        vertices = Icosphere(view.level).num_vertices
        arrays["images"] = (number, 3, vertices), torch.uint8
        arrays["seen"] = (number, vertices), torch.bool
    if view.images:
        arrays["fisheye"] = (number, 3, *size), torch.uint8
        arrays["fisheye_seen"] = (number, *size), torch.bool
    return arrays


def recorded_sample(frame: WorldFrame, height: int) -> dict[str, Any]:
    """Render a frame as sets on disk hold it.

    Args:
        frame: of a world.
        height: rows of the panorama of true depth, which has twice as many columns.

    Returns:
        ``images``, camera name -> ``(3, h, w)`` in [0, 1]; ``inverse_depth`` and ``valid`` ``(height, 2 * height)``;
        ``rig`` and ``frame``.

    Examples:
        >>> from sphericalvision.cameras import ring_rig
        >>> sample = recorded_sample(World(ring_rig(2, image_size=(24, 24))).frame(7), height=16)
        >>> sample["images"]["cam1"].shape, sample["inverse_depth"].shape, sample["frame"]
        (torch.Size([3, 24, 24]), torch.Size([16, 32]), 'room-00000007')
    """
    inverse_depth = frame.inverse_depth(Equirectangular(height, 2 * height).directions)
    return {
        "images": frame.images,
        "inverse_depth": inverse_depth,
        "valid": inverse_depth < float("inf"),
        "rig": frame.rig,
        "frame": frame.name,
    }
