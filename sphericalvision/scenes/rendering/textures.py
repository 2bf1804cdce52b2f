# SPDX-License-Identifier: Apache-2.0
"""Textures of rendered scenes: the photographs inside scikit-image's wheel, and patterns computed from a
seed.

All textures are squares of one size with their mip pyramids, in one table of bytes, so that a look-up for any
mixture of textures and levels is a handful of gathers. The bytes hold square roots of linear intensities.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate

from sphericalvision.core import check_choice, check_file

#: Photographs that scikit-image ships inside its wheel (no download).
PHOTOGRAPHS = (
    "astronaut.png", "brick.png", "camera.png", "chelsea.png", "clock_motion.png", "coffee.png",
    "coins.png", "color.png", "grass.png", "gravel.png", "hubble_deep_field.jpg", "ihc.png", "moon.png",
    "motorcycle_left.png", "page.png", "retina.jpg", "rocket.jpg", "text.png",
)  # fmt: skip
#: Variants of each pattern in the bank, and side length of every texture in pixels.
VARIANTS, SIZE = 4, 256


def photograph(name: str) -> Tensor:
    """One of :data:`PHOTOGRAPHS`, cropped to a square: ``(3, SIZE, SIZE)`` linear intensities in [0, 1]."""
    import skimage.color  # a second to import
    import skimage.data
    import skimage.io

    path = Path(skimage.data.__file__).parent / name
    path = check_file(path, "a photograph of scikit-image's wheel; reinstall scikit-image")
    image = skimage.io.imread(path)
    image = image[:, :, :3] if image.ndim == 3 else skimage.color.gray2rgb(image)
    height, width = image.shape[:2]
    side = min(height, width)
    top, left = (height - side) // 2, (width - side) // 2
    square = torch.from_numpy(image[top : top + side, left : left + side].copy()).permute(2, 0, 1).float()
    resized = interpolate(square[None], (SIZE, SIZE), mode="bilinear", antialias=True)[0]
    return (resized / 255) ** 2.2


@dataclass(frozen=True)
class Canvas:
    """A square on which a pattern is drawn, and its source of randomness.

    Patterns draw their numbers in a fixed order: the textures of all scenes that were rendered so far depend on it.

    Attributes:
        size: side length in pixels.
        generator: of all random choices.
        row: ``(size, size)`` in [0, 1), downwards.
        column: ``(size, size)`` in [0, 1), to the right.
        grain: ``(size, size)``, fine noise that nearly all patterns have a little of.
    """

    size: int
    generator: torch.Generator
    row: Tensor
    column: Tensor
    grain: Tensor

    @classmethod
    def blank(cls, size: int, generator: torch.Generator) -> Canvas:
        """A canvas of a size."""
        row, column = torch.meshgrid(torch.arange(size) / size, torch.arange(size) / size, indexing="ij")
        return cls(size, generator, row, column, _value_noise(generator, size, (16, 16)))

    def choose(self, low: int, high: int) -> int:
        """A whole number from ``low`` to ``high``."""
        return int(torch.randint(low, high + 1, (), generator=self.generator))

    def random(self, *shape: int) -> Tensor:
        """Numbers in [0, 1)."""
        return torch.rand(shape, generator=self.generator)

    def noise(self, cells: tuple[int, int], octaves: int = 4) -> Tensor:
        """Fractal value noise ``(size, size)``."""
        return _value_noise(self.generator, self.size, cells, octaves)


def _value_noise(generator: torch.Generator, size: int, cells: tuple[int, int], octaves: int = 4) -> Tensor:
    """Fractal value noise ``(size, size)`` in about [0, 1]; ``cells`` (down, across) of the coarsest octave."""
    total, weight = torch.zeros(size, size), 0.0
    for octave in range(octaves):
        down, across = (min(count * 2**octave, size // 2) for count in cells)
        grid = torch.rand(1, 1, down + 1, across + 1, generator=generator)
        amplitude = 0.6**octave
        total += amplitude * interpolate(grid, (size, size), mode="bicubic", align_corners=True)[0, 0]
        weight += amplitude
    return (0.5 + 1.4 * (total / weight - 0.5)).clamp(0, 1)


def _noise(canvas: Canvas) -> Tensor:
    return canvas.noise((canvas.choose(2, 8), canvas.choose(2, 8)), octaves=6)


def _checks(canvas: Canvas) -> Tensor:
    count = canvas.choose(2, 6) * 2
    return ((canvas.row * count).floor() + (canvas.column * count).floor()) % 2 * 0.8 + 0.2 * canvas.grain


def _stripes(canvas: Canvas) -> Tensor:
    count, width = canvas.choose(3, 12), 0.2 + 0.6 * float(canvas.random())
    return ((canvas.column * count) % 1 < width).float() * 0.8 + 0.2 * canvas.grain


def _bricks(canvas: Canvas) -> Tensor:
    return _courses(canvas, canvas.choose(6, 10), canvas.choose(2, 4), offset=0.5)


def _tiles(canvas: Canvas) -> Tensor:
    count = canvas.choose(3, 6)
    return _courses(canvas, count, count, offset=0)


def _courses(canvas: Canvas, down: int, across: int, offset: float) -> Tensor:
    """Stones in courses of which every second is moved by ``offset`` of a stone, with joints of one width."""
    row, column = canvas.row, canvas.column
    line = (row * down).floor()
    shifted = column * across + offset * (line % 2)
    tone = canvas.random(down, across + 1)[line.long(), shifted.floor().long()]
    joint = torch.maximum((row * down % 1 - 0.5).abs() / down, (shifted % 1 - 0.5).abs() / across)
    edge = torch.minimum(
        (0.5 - (row * down % 1 - 0.5).abs()) / down, (0.5 - (shifted % 1 - 0.5).abs()) / across
    )
    return torch.where(edge < 0.008, 0.05 * joint, 0.35 + 0.4 * tone + 0.25 * canvas.grain)


def _wood(canvas: Canvas) -> Tensor:
    """Planks side by side, each with rings of its own phase that noise bends."""
    planks = canvas.choose(2, 6)
    plank = (canvas.column * planks).floor().long()
    tone, phase = canvas.random(2, planks)
    bend = canvas.noise((2, 3 * planks), octaves=3)
    rings = 0.5 + 0.5 * torch.sin(40 * (canvas.column * planks % 1 + 0.7 * bend + phase[plank]))
    seam = (canvas.column * planks % 1 < 0.03).float()
    return (0.25 + 0.4 * tone[plank] + 0.25 * rings * bend + 0.1 * canvas.grain) * (1 - 0.8 * seam)


def _mosaic(canvas: Canvas) -> Tensor:
    cells = canvas.choose(4, 12)
    cell = (canvas.row * cells).long(), (canvas.column * cells).long()
    colors = canvas.random(3, cells, cells)
    return colors[:, cell[0], cell[1]] * (0.8 + 0.2 * canvas.grain)


def _dots(canvas: Canvas) -> Tensor:
    count, radius = canvas.choose(3, 10), 0.2 + 0.2 * float(canvas.random())
    distance = torch.hypot(canvas.row * count % 1 - 0.5, canvas.column * count % 1 - 0.5)
    return (distance < radius).float() * 0.8 + 0.2 * canvas.grain


def _marble(canvas: Canvas) -> Tensor:
    swirl = canvas.noise((3, 3), octaves=6)
    veins = torch.sin(canvas.choose(8, 20) * (canvas.row + canvas.column + 1.5 * swirl))
    return (0.5 + 0.5 * veins) ** 2 * 0.7 + 0.3 * canvas.grain


def _weave(canvas: Canvas) -> Tensor:
    """Threads, alternately from left to right and from top to bottom, darker towards their edges."""
    count, row, column = canvas.choose(12, 24), canvas.row, canvas.column
    over = ((row * count).floor() + (column * count).floor()) % 2
    thread = torch.where(over > 0, (row * count % 1 - 0.5).abs(), (column * count % 1 - 0.5).abs())
    return (1 - thread) * (0.6 + 0.4 * canvas.noise((4, 4)))


def _spectrum(canvas: Canvas) -> Tensor:
    """Noise of all wavelengths, down to single texels, a little different in each colour."""
    cells = canvas.choose(2, 5)
    layers = [canvas.noise((cells, cells), octaves=7) for _ in range(4)]
    colors = 0.65 * layers[0] + 0.35 * torch.stack(layers[1:])
    return 0.5 + 1.5 * (colors - 0.5)


def _cells(canvas: Canvas) -> Tensor:
    """Gravel, scales or cracked mud: the cells of random points, with dark joints."""
    points = canvas.random(canvas.choose(30, 150), 2)
    tone = canvas.random(len(points))
    distances = torch.cdist(torch.stack([canvas.row, canvas.column], -1).flatten(0, 1), points)
    nearest, ids = distances.topk(2, largest=False)
    joint = (nearest.diff(dim=-1)[:, 0] * len(points) ** 0.5 * 4).clamp(max=1)
    image = (joint * (0.35 + 0.65 * tone[ids[:, 0]])).view(canvas.size, canvas.size)
    return image * (0.6 + 0.4 * canvas.grain)


def _specks(canvas: Canvas) -> Tensor:
    """Plaster, ceiling tiles or carpet: small dark spots, dense or sparse, on one tone."""
    density, fine = canvas.choose(2, 30) / 100, canvas.noise((canvas.choose(24, 96),) * 2, octaves=2)
    return 1 - (fine > fine.quantile(1 - density)).float() * canvas.random(canvas.size, canvas.size)


#: Procedural patterns: an image ``(size, size)`` or ``(3, size, size)``, still to be clamped to [0, 1].
ALL_PATTERNS: dict[str, Callable[[Canvas], Tensor]] = {
    "noise": _noise,
    "checks": _checks,
    "stripes": _stripes,
    "bricks": _bricks,
    "wood": _wood,
    "tiles": _tiles,
    "mosaic": _mosaic,
    "dots": _dots,
    "marble": _marble,
    "weave": _weave,
    "spectrum": _spectrum,
    "cells": _cells,
    "specks": _specks,
}
#: Patterns that any kind of scene may draw. Only kinds that name them draw the last three, so that the seeds of older
#: kinds give the same scenes.
PATTERNS = tuple(ALL_PATTERNS)[:-3]


def pattern(name: str, generator: torch.Generator, size: int = SIZE) -> Tensor:
    """A procedural pattern ``(3, size, size)`` in [0, 1], grey except for mosaic and spectrum; materials give it
    its colours.

    Examples:
        >>> pattern("checks", torch.Generator().manual_seed(0), size=32).shape
        torch.Size([3, 32, 32])
    """
    check_choice("name", name, tuple(ALL_PATTERNS))
    image = ALL_PATTERNS[name](Canvas.blank(size, generator))
    return image.clamp(0, 1).expand(3, -1, -1)


@dataclass(frozen=True)
class TextureBank:
    """Square textures with their mip pyramids.

    Attributes:
        texels: ``(N, 4)`` bytes, textures one after another, each finest level first; the fourth is padding.
        names: what the textures are called.
        size: side length of the finest level.
    """

    texels: Tensor
    names: tuple[str, ...]
    size: int

    @property
    def num_levels(self) -> int:
        return self.size.bit_length()

    def columns(self, texture: Tensor, across: Tensor, down: Tensor, footprint: Tensor) -> Tensor:
        """Trilinear look-up, mirrored beyond [0, 1]: ``(3, n)`` linear intensities.

        Args:
            texture: ``(n,)`` texture numbers.
            across: ``(n,)``, 1 is the texture's side.
            down: as `across`.
            footprint: ``(n,)`` width to average over, in texture sides.
        """
        level = (footprint * self.size).clamp(min=1).log2_().clamp_(max=self.num_levels - 1)
        fine = level.floor()
        blend = level.sub_(fine)
        fine = fine.int()
        # Mirrored in [0, 1]: the distance to the nearest even number.
        across, down = (torch.sub(x, (x / 2).round_(), alpha=2).abs_() for x in (across, down))
        start = texture.int() * self._pyramid
        total = across.new_zeros(3, len(across))
        for number, share in ((fine, 1 - blend), (fine + 1, blend)):
            self._add_bilinear(total, start, across, down, number.clamp_(max=self.num_levels - 1), share)
        return total.mul_(self._scale)

    def _add_bilinear(
        self, total: Tensor, start: Tensor, across: Tensor, down: Tensor, level: Tensor, share: Tensor
    ) -> None:
        """Add ``share`` of a look-up at whole levels to ``total`` ``(3, n)``, in units of `_scale`."""
        side, offset = self._sides.index_select(0, level), self._offsets.index_select(0, level)
        most = side - 1
        # Beyond the centres of the outermost texels their mirror images follow, which are the same.
        x, y = (torch.minimum((p * side).sub_(0.5).clamp_(min=0), most) for p in (across, down))
        left, top = x.floor(), y.floor()
        x, y = x.sub_(left), y.sub_(top)
        whole = side.int()
        index = left.int().add_(top.int().mul_(whole)).add_(start).add_(offset)
        lower = y * share
        upper = share - lower
        for row, weight in ((index, upper), (index + whole, lower)):
            right = x * weight
            # The last texel has none to its right, but the weight there is 0, and the table is padded.
            for texel, part in ((row, weight - right), (row + 1, right)):
                root = (self._packed.index_select(0, texel) & self._masks).to(total.dtype)
                total.addcmul_(root * part, root)

    @cached_property
    def _pyramid(self) -> int:
        """Texels of one texture: a pyramid of side s has (4 s² - 1) / 3."""
        return (4 * self.size**2 - 1) // 3

    @cached_property
    def _sides(self) -> Tensor:
        """Side of each level."""
        sides = [float(self.size >> k) for k in range(self.num_levels)]
        return torch.tensor(sides, device=self.texels.device)

    @cached_property
    def _offsets(self) -> Tensor:
        """Texels of a texture before each level: the part below level k is a pyramid, too."""
        below = [(4 * (self.size >> k) ** 2 - 1) // 3 for k in range(self.num_levels)]
        return torch.tensor([self._pyramid - n for n in below], dtype=torch.int32, device=self.texels.device)

    @cached_property
    def _packed(self) -> Tensor:
        """Texels as one number each, red in the lowest byte; a gather of these is faster than one of bytes."""
        padded = torch.cat([self.texels, self.texels.new_zeros(2, 4)]).int()
        return padded[:, 0] + (padded[:, 1] << 8) + (padded[:, 2] << 16)

    @cached_property
    def _masks(self) -> Tensor:
        """Where the three channels are in a packed texel ``(3, 1)``."""
        return torch.tensor([[255], [255 << 8], [255 << 16]], dtype=torch.int32, device=self.texels.device)

    @cached_property
    def _scale(self) -> Tensor:
        """Turns the squares of masked texels into linear intensities ``(3, 1)``."""
        return self._masks.double().reciprocal().square().float()


@lru_cache(maxsize=4)
def texture_bank(device: str = "cpu") -> TextureBank:
    """All photographs and `VARIANTS` of each pattern; made once for each device and shared by all scenes."""
    generator = torch.Generator().manual_seed(0)
    images = [photograph(name) for name in PHOTOGRAPHS]
    images += [pattern(name, generator) for name in ALL_PATTERNS for _ in range(VARIANTS)]
    level = torch.stack(images)
    pyramid = []
    while True:
        pyramid.append(level.flatten(2).mT)
        if level.shape[-1] == 1:
            break
        level = avg_pool2d(level, 2)
    linear = torch.cat(pyramid, 1).flatten(0, 1)
    texels = torch.zeros(len(linear), 4, dtype=torch.uint8)
    texels[:, :3] = (linear.sqrt() * 255).round().to(torch.uint8)
    names = PHOTOGRAPHS + tuple(f"{name} {k}" for name in ALL_PATTERNS for k in range(VARIANTS))
    return TextureBank(texels.to(device), names, SIZE)
