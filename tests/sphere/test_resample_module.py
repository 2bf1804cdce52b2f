# SPDX-License-Identifier: Apache-2.0
"""``Resample`` and what resampling does with cameras, masks, depth and gradients."""

import inspect
import math

import pytest
import torch
from torch import Tensor, nn

from sphericalvision.cameras import (
    EquirectangularCamera,
    FisheyeCamera,
    KannalaBrandtCamera,
    PinholeCamera,
    Remap,
    remap,
    remap_mask,
)
from sphericalvision.core import ArgumentError
from sphericalvision.icosphere import Icosphere
from sphericalvision.sphere import (
    Cubemap,
    Equirectangular,
    Healpix,
    Resample,
    SphereGrid,
    TangentImages,
    resample,
    resample_mask,
)
from tests.laws.grid_laws import DOUBLE, GRIDS, some_rotation

FISHEYE = FisheyeCamera.from_field_of_view((48, 64), math.radians(200)).to(DOUBLE)
SMALL = [Equirectangular(6, 12), Cubemap(4), Healpix(2), Icosphere(1), TangentImages(0, 5)]


@pytest.mark.parametrize("mode", ["bilinear", "nearest", "area"])
@pytest.mark.parametrize("source", [*SMALL, FISHEYE], ids=lambda source: type(source).__name__)
def test_module_is_the_function(source: SphereGrid | FisheyeCamera, mode: str) -> None:
    shape = source.image_size if isinstance(source, FisheyeCamera) else source.shape
    values = torch.rand(2, 3, *shape, dtype=DOUBLE)
    for target in (Icosphere(1), FISHEYE):
        module = Resample(source, target, some_rotation(), mode, fill=-1, dtype=DOUBLE)
        torch.testing.assert_close(
            module(values),
            resample(values, source, target, some_rotation(), mode, fill=-1),
            rtol=0,
            atol=1e-12,
        )
        assert torch.equal(module.mask(), resample_mask(source, target, some_rotation(), mode))
        assert module.state_dict() == {}
        assert list(module.parameters()) == []


def test_module_moves_and_leaves_the_grid_alone() -> None:
    grid = Cubemap(4)
    module = Resample(grid, Equirectangular(6, 12))
    assert {b.dtype for b in module.buffers() if b.is_floating_point()} == {torch.float32}
    module.to(DOUBLE).to("meta")
    assert {b.device.type for b in module.buffers()} == {"meta"}
    assert grid.directions.dtype == torch.float32
    assert grid.directions.device.type == "cpu"


@pytest.mark.parametrize("source", [SMALL[1], SMALL[3], FISHEYE], ids=lambda source: type(source).__name__)
def test_module_compiles_whole(source: SphereGrid | FisheyeCamera) -> None:
    shape = source.image_size if isinstance(source, FisheyeCamera) else source.shape
    values, mask = torch.rand(1, 2, *shape, dtype=DOUBLE), torch.rand(1, *shape) > 0.2
    module = Resample(source, Icosphere(1), mode="area", dtype=DOUBLE)
    compiled = torch.compile(module, fullgraph=True, backend="eager")
    torch.testing.assert_close(compiled(values, mask), module(values, mask))


@pytest.mark.parametrize("source", GRIDS)
def test_masked_values_do_not_matter(source: str) -> None:
    """NaN under the mask never comes out; what is left is a mean of usable values."""
    grid, target = GRIDS[source].make(2), Icosphere(2, dtype=DOUBLE)
    usable = (grid.directions[..., 0] > -0.2).expand(2, *grid.shape)
    values = torch.where(usable.unsqueeze(1), 2.0, torch.nan).double()
    for mode in ("bilinear", "area", "nearest"):
        result = resample(values, grid, target, mode=mode, fill=-7.0, mask=usable)
        valid = resample_mask(grid, target, mode=mode, mask=usable)
        assert valid.shape == (2, 162)
        torch.testing.assert_close(result[:, 0], torch.where(valid, 2.0, -7.0).double(), rtol=0, atol=1e-12)
        x = target.directions[:, 0]
        assert valid[:, (x > 0) & resample_mask(grid, target, mode=mode)].all()
        assert not valid[:, x < -0.7].any()


def test_pixels_that_the_camera_does_not_see_do_not_matter() -> None:
    """Around a fisheye's circle images hold anything; interpolation at its rim leaves it out."""
    seen = FISHEYE.unproject(FISHEYE.pixel_grid(DOUBLE)).valid
    image = torch.where(seen, 1.0, torch.nan).double()[None]
    for mode in ("bilinear", "area"):
        for target in (Equirectangular(24, 48), Healpix(4), FISHEYE):
            result = resample(image, FISHEYE, target, some_rotation(), mode)
            valid = resample_mask(FISHEYE, target, some_rotation(), mode)
            torch.testing.assert_close(result[0], valid.double())
            assert 0.2 < valid.double().mean() < 0.8


def test_partial_grids_tell_what_they_see() -> None:
    target = Healpix(8, dtype=DOUBLE)
    angle = torch.atan2(target.directions[:, :2].norm(dim=-1), target.directions[:, 2])
    image = torch.zeros(48, 48)
    camera = FisheyeCamera.from_field_of_view((48, 48), math.radians(200))
    valid = resample_mask(camera, target)
    clear = (angle - math.radians(100)).abs() > 1e-5
    assert torch.equal(valid[clear], angle[clear] <= math.radians(100))
    assert (resample(image[None], camera, target, fill=9.0)[0] == torch.where(valid, 0.0, 9.0)).all()


def test_area_of_a_nested_pair_is_the_exact_mean() -> None:
    """Where cells fall into whole cells, the average is known."""
    image = torch.rand(1, 16, 32, dtype=DOUBLE)
    weight = Equirectangular(16, 32, dtype=DOUBLE).solid_angles
    small = resample(image, Equirectangular(16, 32), Equirectangular(8, 16), mode="area")
    blocks = (image * weight).view(1, 8, 2, 16, 2).sum((2, 4)) / weight.view(8, 2, 16, 2).sum((1, 3))
    torch.testing.assert_close(small, blocks, rtol=5e-3, atol=0)
    pixels = torch.rand(1, 768, dtype=DOUBLE)
    coarse = resample(pixels, Healpix(8, nested=True), Healpix(4, nested=True), mode="area")
    assert (coarse - pixels.view(1, 192, 4).mean(-1)).abs().max() < 0.25  # samples lie between the rings
    assert coarse.mean().item() == pytest.approx(pixels.mean().item(), abs=2e-3)


def test_area_of_a_growing_image_is_bilinear() -> None:
    image = torch.rand(1, 8, 16, dtype=DOUBLE)
    source, target = Equirectangular(8, 16), Cubemap(16)
    assert torch.equal(resample(image, source, target, mode="area"), resample(image, source, target))


@pytest.mark.parametrize("mode", ["bilinear", "area"])
def test_gradients_by_intrinsics(mode: str) -> None:
    image = torch.rand(1, 12, 24, dtype=DOUBLE)
    focal_length = torch.tensor([5.1, 5.3], dtype=DOUBLE, requires_grad=True)
    center = torch.tensor([2.6, 2.4], dtype=DOUBLE, requires_grad=True)

    def perspective(focal_length: Tensor, center: Tensor) -> Tensor:
        return resample(
            image, Equirectangular(12, 24), PinholeCamera(focal_length, center, (6, 6)), mode=mode
        )

    assert torch.autograd.gradcheck(perspective, (focal_length, center))
    distortion = torch.tensor([0.02, 0.01, 0.0, 0.0], dtype=DOUBLE, requires_grad=True)

    def onto_sphere(distortion: Tensor) -> Tensor:
        lens = KannalaBrandtCamera(
            torch.tensor([5.0, 5.0]), torch.tensor([5.5, 5.5]), distortion, (12, 12), 1.0
        )
        return resample(image[..., :12], lens, Icosphere(1), mode=mode)

    assert torch.autograd.gradcheck(onto_sphere, (distortion,))


class Ring:
    """The least a grid must have: values at four directions of the horizon, the nearest counts."""

    shape = (4,)
    directions = torch.tensor([[0.0, 0, 1], [1, 0, 0], [0, 0, -1], [-1, 0, 0]])
    solid_angles = torch.full((4,), math.pi)

    def nearest(self, directions: Tensor) -> Tensor:
        return (directions @ self.directions.T.to(directions)).argmax(-1)

    def sample(self, values: Tensor, directions: Tensor) -> Tensor:
        return values[..., self.nearest(directions)]


def test_any_grid_takes_part() -> None:
    values = torch.tensor([[1.0, 2.0, 3.0, 4.0]])
    result = resample(values, Ring(), Equirectangular(4, 8))
    assert result[0, 1].tolist() == [3, 4, 4, 1, 1, 2, 2, 3]
    assert resample(result, Equirectangular(4, 8), Ring(), mode="nearest").shape == (1, 4)
    with pytest.raises(ArgumentError, match=r"needs a method cell_samples.* which Ring lacks"):
        resample(torch.zeros(1, 40, 80), Equirectangular(40, 80), Ring(), mode="area")


@pytest.mark.parametrize("mode", ["bilinear", "area"])
@pytest.mark.parametrize("kind", [torch.float16, torch.bfloat16])
def test_a_network_in_half_precision_looks_up_at_the_same_places(mode: str, kind: torch.dtype) -> None:
    """Columns of a panorama are counted beyond what half precision can."""
    wide, few = Equirectangular(8, 2048), Icosphere(2)
    values = torch.rand(1, 3, 8, 2048).to(kind)
    module = Resample(wide, few, mode=mode)
    expected = module(values)
    assert torch.equal(nn.Sequential(module).to(kind)(values), expected)


def test_convention_remap_and_resample_are_called_alike() -> None:
    """One order of arguments and one kind of result, for functions, masks and modules."""
    for ours, theirs in ((resample, remap), (resample_mask, remap_mask), (Resample, Remap)):
        names, others = (list(inspect.signature(each).parameters) for each in (ours, theirs))
        assert [name.replace("image", "values") for name in others] == names
    target = PinholeCamera([20.0, 20.0], [15.5, 11.5], (24, 32))
    panorama = torch.rand(3, 16, 32, dtype=DOUBLE)
    turn = some_rotation()
    expected = resample(panorama, Equirectangular(16, 32), target, turn)
    torch.testing.assert_close(
        remap(panorama, EquirectangularCamera((16, 32)), target, turn), expected, rtol=0, atol=1e-12
    )
    fisheye_mask = remap_mask(FISHEYE, target, turn)
    assert torch.equal(fisheye_mask, Remap(FISHEYE, target, turn).mask())
    assert torch.equal(fisheye_mask, resample_mask(FISHEYE, target, turn))


def test_a_mask_of_all_calls_and_one_of_a_single_call_count_both() -> None:
    grid, target = Equirectangular(8, 16, DOUBLE), Icosphere(2, DOUBLE)
    left, upper = grid.directions[..., 0] < 0.3, grid.directions[..., 1] < 0.3
    values = torch.rand(1, 8, 16, dtype=DOUBLE)
    both = resample(values, grid, target, mask=left & upper)
    module = Resample(grid, target, mask=left, dtype=DOUBLE)
    torch.testing.assert_close(module(values, upper), both)
    torch.testing.assert_close(module(values), resample(values, grid, target, mask=left))
    assert torch.equal(module.mask(upper), resample_mask(grid, target, mask=left & upper))
    filled = Resample(grid, target, fill=-3.0, mask=left, dtype=DOUBLE)
    expected = torch.where(module.mask(upper), both, -3.0)
    torch.testing.assert_close(filled(values, upper), expected)
