# SPDX-License-Identifier: Apache-2.0
"""Sphere sweep onto a panorama: the cameras' values at the pixels of concentric spheres."""

from __future__ import annotations

from typing import ClassVar, NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor

from sphericalvision.cameras import CameraRig
from sphericalvision.cameras.checks import check_image
from sphericalvision.core import ArgumentError, ShapeError, check_type
from sphericalvision.geometry.lookup import PlacesInSinglePrecision
from sphericalvision.shapes import check_shapes
from sphericalvision.sphere import Equirectangular
from sphericalvision.sweep.hypotheses import check_hypotheses, inverse_depth_hypotheses


class PanoramaTables(NamedTuple):
    """Tables of a rig: the position of every pixel of every sphere in the image of each camera.

    A rig that is shared by the batch has tables without a batch dimension.

    Attributes:
        grid: ``([B,] n, D, h, w, 2)`` positions as ``grid_sample(align_corners=False)`` takes them.
        seen: ``([B,] n, D, h, w)`` True inside the camera's field of view, image and mask; occlusion is not known.
        image_size: (height, width) of the images that the cameras are calibrated for.
    """

    grid: Float[Tensor, "*batch n D h w 2"]
    seen: Bool[Tensor, "*batch n D h w"]
    image_size: tuple[int, int]

    @property
    def num_cameras(self) -> int:
        """n, the number of cameras."""
        return self.seen.shape[-4]

    def to(self, device: torch.device | str) -> PanoramaTables:
        """Return the tables on another device."""
        return PanoramaTables(self.grid.to(device), self.seen.to(device), self.image_size)

    def every_second_pixel(self) -> PanoramaTables:
        """Return the tables of every second row and column of the spheres."""
        return self._replace(grid=self.grid[..., ::2, ::2, :], seen=self.seen[..., ::2, ::2])

    def at_spheres(self, index: Int[Tensor, "B h w"]) -> PanoramaTables:
        """Return the tables of one surface: at each pixel the sphere of an index ``(B, h, w)``."""
        batch, (rows, columns) = len(index), index.shape[-2:]
        chosen = index[:, None, None].expand(batch, self.num_cameras, 1, rows, columns)
        grid = self.grid.expand(batch, *self.grid.shape[-5:])
        grid = grid.gather(2, chosen.unsqueeze(-1).expand(*chosen.shape, 2))
        return self._replace(grid=grid, seen=self.seen.expand(batch, *self.seen.shape[-4:]).gather(2, chosen))


class PanoramaSweep(PlacesInSinglePrecision):
    """Sweep concentric spheres with the pixels of a panorama through feature maps of the cameras.

    A pixel of direction d at inverse depth w is the point ``rig.center + d / w``. A camera at c sees it in the
    direction ``d + w * (rig.center - c)``, which is exact up to infinity, and projects this.

    Convention:
        Pixel i of a map is centred at pixel ``stride * i`` of the image, as after convolutions with odd kernels of size
        k, padding (k - 1) / 2 and strides that multiply to ``stride``: maps have ceil(size / stride) pixels. Values
        are linear between centres, constant for half a pixel beyond the outermost ones, and zero out of view.

    Args:
        output_size: (height, width) of the panorama, see ``Equirectangular.with_square_pixels``.
        num_hypotheses: N.
        min_depth: radius of the smallest sphere in metres.
        stride: pixels of the images between those of the maps.
        every: 2 sweeps every second sphere, 3 every third, ..., from the farthest on.

    Raises:
        ArgumentError: sizes that are not positive, fewer than two hypotheses, a smallest depth that is not
            positive.

    References:
        Won, Ryu and Lim (2019), "OmniMVS: end-to-end learning for omnidirectional stereo matching", section 3.2.

    Examples:
        >>> from sphericalvision.cameras import ring_rig
        >>> sweep = PanoramaSweep((8, 16), num_hypotheses=4, min_depth=0.5)
        >>> values = sweep(torch.ones(1, 2, 5, 20, 20), ring_rig(2, image_size=(40, 40)))
        >>> values.shape  # cameras, channels, every second of four spheres, rows, columns
        torch.Size([1, 2, 5, 2, 8, 16])
    """

    directions: Tensor
    inverse_depths: Tensor
    align_corners: ClassVar[bool] = False
    outside: ClassVar[float] = -3.0  # the place of what is out of view: so far off the image that all is 0

    def __init__(
        self,
        output_size: tuple[int, int],
        num_hypotheses: int,
        min_depth: float,
        stride: int = 2,
        every: int = 2,
    ) -> None:
        super().__init__()
        check_hypotheses(num_hypotheses, min_depth)
        self.grid = Equirectangular.with_square_pixels(*output_size)
        self.num_hypotheses, self.min_depth = num_hypotheses, min_depth
        self.stride, self.every = stride, every
        # Exact in float64, cast to the dtype of the rig in use.
        directions = Equirectangular.with_square_pixels(*output_size, torch.float64).directions
        self.register_buffer("directions", directions.reshape(-1, 3), persistent=False)
        hypotheses = inverse_depth_hypotheses(num_hypotheses, min_depth, torch.float64)[::every]
        self.register_buffer("inverse_depths", hypotheses, persistent=False)

    def tables(self, rig: CameraRig) -> PanoramaTables:
        """Return the tables of a rig, which may be passed to ``forward`` in its place.

        Raises:
            ArgumentError: if the cameras' images differ in size.
        """
        check_type("rig", rig, CameraRig, "ring_rig makes one, read_rig reads one")
        sizes = {camera.image_size for camera in rig.cameras.values()}
        if len(sizes) > 1:
            raise ArgumentError(
                f"rig: expected cameras with images of one size, got {', '.join(map(str, sorted(sizes)))}; "
                "bring images and rig to one size with rig.resized"
            )
        (size,) = sizes
        rig = rig.to(self.directions.device)
        dtype = rig.world_from_camera.dtype
        pixels, seen = rig.project_along(self.directions.to(dtype), self.inverse_depths.to(dtype))
        grid = self._normalized(pixels, seen, size)
        return PanoramaTables(grid.unflatten(-2, self.grid.shape), seen.unflatten(-1, self.grid.shape), size)

    def tables_for(
        self, images: Float[Tensor, "B _ C H W"], rig: CameraRig | PanoramaTables
    ) -> PanoramaTables:
        """Return the tables of a rig for images.

        Raises:
            ShapeError: images of another size, or tables of another panorama or number of hypotheses.
        """
        tables = rig if isinstance(rig, PanoramaTables) else self.tables(rig)
        spheres = (len(self.inverse_depths), *self.grid.shape)
        if tuple(tables.seen.shape[-3:]) != spheres:
            raise ShapeError(
                f"rig: expected tables of (spheres, h, w) = {spheres}, as this sweep makes them, got "
                f"{tuple(tables.seen.shape[-3:])}"
            )
        check_image("images", images, tables.image_size, remedy="resize them, or take rig.resized")
        return tables

    def _normalized(self, pixels: Tensor, seen: Tensor, image_size: tuple[int, int]) -> Tensor:
        """Positions (*, 2) on the maps as ``grid_sample`` takes them."""
        height, width = map_size(image_size, self.stride)
        size = pixels.new_tensor([width, height])
        coordinates = torch.minimum((pixels / self.stride).clamp(min=0), size - 1)
        return torch.where(seen.unsqueeze(-1), (2 * coordinates + 1) / size - 1, self.outside)

    def camera_values(
        self, features: Float[Tensor, "B C h_f w_f"], tables: PanoramaTables, camera: int
    ) -> Float[Tensor, "B C D h w"]:
        """Values ``(B, C, D, h, w)`` of the maps ``(B, C, h_f, w_f)`` of one camera; zero out of view."""
        grid = tables.grid[..., camera, :, :, :, :].to(features.dtype)
        coordinates = grid.flatten(-4, -3).expand(len(features), -1, -1, 2)
        values = F.grid_sample(features, coordinates, align_corners=self.align_corners)
        return values.unflatten(2, grid.shape[-4:-2])

    def forward(
        self, features: Float[Tensor, "B n C h_f w_f"], rig: CameraRig | PanoramaTables
    ) -> Float[Tensor, "B n C D h w"]:
        """Sweep maps ``(B, n, C, h_f, w_f)`` of a rig's n cameras: values ``(B, n, C, D, h, w)``, zero out of view.

        Raises:
            ShapeError: if maps and rig do not fit.
        """
        tables = rig if isinstance(rig, PanoramaTables) else self.tables(rig)
        self.check_maps(features, tables)
        cameras = range(tables.num_cameras)
        return torch.stack([self.camera_values(features[:, k], tables, k) for k in cameras], 1)

    @check_shapes
    def seen(
        self, tables: PanoramaTables, seen: Bool[Tensor, "B n H W"] | Bool[Tensor, "n H W"] | None = None
    ) -> Bool[Tensor, "*batch n D h w"]:
        """Whether each camera sees each point ``([B,] n, D, h, w)``, and its image shows something there.

        Args:
            tables: of the rig.
            seen: ``([B,] n, H, W)``, True where the images show something; everywhere when not given.

        Raises:
            ShapeError: if ``seen`` has another size than the rig's images.
        """
        if seen is None:
            return tables.seen
        check_image("seen", seen, tables.image_size, "([B,] n, h, w)", "resize it, or take rig.resized")
        seen = seen[None] if seen.ndim == 3 else seen
        if tables.seen.ndim == 5:
            seen = seen.expand(len(tables.seen), *seen.shape[1:])
        maps = seen[:, :, None, :: self.stride, :: self.stride].to(tables.grid)
        return tables.seen & (self(maps, tables).squeeze(2) > 0.5)

    @check_shapes
    def check_maps(self, features: Float[Tensor, "B n C h_f w_f"], tables: PanoramaTables) -> None:
        """Raise ``ShapeError`` unless maps and tables fit."""
        expected = map_size(tables.image_size, self.stride)
        if tuple(features.shape[-2:]) != expected:
            raise ShapeError(
                f"features: expected shape (B, n, C, {expected[0]}, {expected[1]}) for images of "
                f"{tables.image_size[0]} x {tables.image_size[1]} pixels, got {tuple(features.shape)}"
            )
        if features.shape[1] != tables.num_cameras:
            raise ShapeError(
                f"features: got {features.shape[1]} cameras, but the rig has {tables.num_cameras}; "
                "pass images in the order of rig.names"
            )
        if tables.seen.ndim == 5 and len(tables.seen) != len(features):
            raise ShapeError(
                f"rig: expected one rig for each of {len(features)} samples or a shared one, "
                f"got {len(tables.seen)} rigs"
            )

    def extra_repr(self) -> str:
        return (
            f"num_hypotheses={self.num_hypotheses}, min_depth={self.min_depth}, stride={self.stride}, "
            f"every={self.every}"
        )


def map_size(image_size: tuple[int, int], stride: int) -> tuple[int, int]:
    """Height and width of a map of an image."""
    return -(-image_size[0] // stride), -(-image_size[1] // stride)
