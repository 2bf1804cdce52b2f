# SPDX-License-Identifier: Apache-2.0
"""Laws of every public function, module and class of tensors: one table of calls, ``tests/laws/operators.py``.

The meta device shows what a machine without a GPU cannot: a tensor made on the wrong device, or a look at a number
(``.item()``, ``bool(...)``, ``nonzero``), which on a GPU waits for all that was asked for before. What does not run
there is listed with its reason, so a new name is in one of the two tables.
"""

from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor

from sphericalvision import cameras, crown, geometry, icosphere, losses, metrics, sphere, sweep
from sphericalvision.core import ArgumentError, ArgumentTypeError, ShapeError
from sphericalvision.kernels import kernels
from tests.laws.operators import CALLS, EXCEPTIONS, Inputs, call
from tests.test_public_api import public_names


def test_every_public_name_is_in_one_of_the_tables() -> None:
    names = {line.partition(": ")[2] for line in public_names()}
    assert not set(CALLS) & set(EXCEPTIONS)
    assert set(CALLS) | set(EXCEPTIONS) == names, set(CALLS) ^ set(EXCEPTIONS) ^ names


ROOMS = (cameras, crown, geometry, icosphere, losses, metrics, sphere, sweep)
NAMES = {room: [name for name in dir(room) if name in CALLS] for room in ROOMS}


def names(*rooms: Any, without: str = "") -> pytest.MarkDecorator:
    """Names of rooms, without some."""
    return pytest.mark.parametrize(
        "name", [name for room in rooms for name in NAMES[room] if name not in without.split()]
    )


TABLES = """
Camera remap_mask undistorted_camera north_fraction icosphere_edges icosphere_faces icosphere_neighbors icosphere_rings
icosphere_solid_angles icosphere_vertices icosphere_voronoi_solid_angles nested_from_ring ring_from_nested resample_mask
sphere_taps SphereGrid SweepTables semi_global_tables inverse_depth_hypotheses
"""
"""Names that take no tensor of numbers."""


def assert_same(found: list[Tensor], expected: list[Tensor], tolerance: float = 0.0) -> None:
    assert expected
    for one, other in zip(found, expected, strict=True):
        torch.testing.assert_close(one, other, rtol=tolerance, atol=tolerance, equal_nan=True)


@pytest.mark.parametrize("name", CALLS)
def test_it_runs_on_the_meta_device(name: str) -> None:
    results = call(name, Inputs())
    assert results
    assert {tensor.device.type for tensor in results} == {"meta"}


@pytest.mark.parametrize("name", CALLS)
def test_it_takes_a_batch_of_none_and_has_gradients_of_it(name: str) -> None:
    inputs = Inputs("cpu", sizes={1: 0, 5: 0})
    assert call(name, inputs)
    leaves = [x.requires_grad_() if x.is_floating_point() else x for _, x in inputs.made]
    for found in call(name, Inputs("cpu", replayed=iter(leaves))):
        if found.requires_grad and name != "RomniStereo":  # torch's pixel_shuffle has no gradient of none
            found.sum().backward(retain_graph=True)


@names(
    cameras, geometry, icosphere, losses, metrics, sphere, sweep,
    without="SphereConv2d sphere_conv2d make_seamless Concatenation",  # convolutions, which autocast is for
)  # fmt: skip
def test_autocast_leaves_its_numbers_alone(name: str) -> None:
    expected = call(name, Inputs("cpu", sizes={5: 500}))
    with torch.autocast("cpu", torch.bfloat16):
        assert_same(call(name, Inputs("cpu", sizes={5: 500})), expected)


CONVOLUTIONS = """CrownConv2d CrownConv3d HexConv2d HexConv3d HexLiftConv2d HexGroupConv2d crown_conv2d crown_conv3d
hex_conv2d hex_conv3d hex_lift_conv2d hex_group_conv2d SphereConv2d sphere_conv2d make_seamless"""


@pytest.mark.parametrize("way", ["plain", "graph", "reference"])
@pytest.mark.parametrize("name", CONVOLUTIONS.split())
def test_autocast_casts_convolutions_as_those_of_torch(name: str, way: str) -> None:
    expected = call(name, Inputs("cpu"))
    with kernels(way), torch.autocast("cpu", torch.bfloat16):
        found = call(name, Inputs("cpu"))
    assert {x.dtype for x in found} == {torch.bfloat16}
    assert_same([x.float() for x in found], expected, 0.02)


@pytest.mark.parametrize("name", [name for name in CONVOLUTIONS.split() if "_conv" in name])
def test_transforms_of_functions_equal_the_loop(name: str) -> None:
    """A gradient for every sample and each of an ensemble of weights; by one input alone it is the same."""
    inputs = Inputs("cpu", torch.float64)
    call(name, inputs)
    several = [torch.stack((x, x.flip(-1))) for _, x in inputs.made]

    def loss(*leaves: Tensor) -> Tensor:
        results = call(name, Inputs("cpu", torch.float64, replayed=iter(leaves)))
        return torch.stack([x.square().sum() for x in results]).sum()

    gradients = torch.func.grad(loss, tuple(range(len(several))))
    together = torch.func.vmap(gradients)(*several)
    for number in range(2):
        leaves = [x[number] for x in several]
        for index, found in enumerate(together):
            alone = [x.clone().requires_grad_(i == index) for i, x in enumerate(leaves)]
            assert_same([found[number]], list(torch.autograd.grad(loss(*alone), alone[index])), 1e-9)


@names(
    cameras, geometry, icosphere, losses, metrics, sphere, sweep,
    without=f"""{TABLES} angular_error Aggregation Concatenation MeanVariance SphereSweep PanoramaSweep SweepVolume
    sphere_sweep photo_consistency_share CameraRig remap resample views Icosphere IcospherePool icosphere_pool
    icosphere_normals Healpix SphereConv2d sphere_conv2d make_seamless rotation_from_yaw_pitch_roll
    transform_from_axis_angle transform_from_quaternion transform_points""",
)  # fmt: skip
def test_half_precision_is_computed_in_single(name: str) -> None:
    """Of the numbers as they were rounded, and nothing is rounded again but the result."""
    inputs = Inputs("cpu", torch.float16)
    found = call(name, inputs)
    exact = [x.float() if x.is_floating_point() else x for _, x in inputs.made]
    expected = call(name, Inputs("cpu", replayed=iter(exact)))
    assert_same(found, [x.to(y.dtype) for x, y in zip(expected, found, strict=True)])


@names(
    *ROOMS,
    without=f"""{TABLES} directions_from_longitude_latitude depth_from_index index_from_depth index_from_inverse_depth
    inverse_depth_from_index""",  # of one dimension
)
def test_inputs_are_left_alone_and_may_lie_in_any_order_in_memory(name: str) -> None:
    inputs = Inputs("cpu")
    expected = call(name, inputs)
    assert any(x.ndim > 1 for _, x in inputs.made)
    before = [x.clone() for _, x in inputs.made]
    mirrored = [x.mT.contiguous().mT if x.ndim > 1 else x for _, x in inputs.made]
    assert_same(call(name, Inputs("cpu", replayed=iter(mirrored))), expected, 1e-5)
    for tensors in (mirrored, [x for _, x in inputs.made]):
        assert all(map(torch.equal, before, tensors))


@names(
    crown, geometry, icosphere, losses, metrics, sphere, sweep,
    without=f"""{TABLES} bilinear_sample invert_transform icosphere_normals depth_index_huber Cubemap Equirectangular
    Healpix TangentImages healpix_pool healpix_upsample CubePad2d equirectangular_pad cube_from_layout cube_to_layout
    Resample seam_mask soft_argmax soft_argmax_confidence views""",  # which have no such dimension, or not as the first
)  # fmt: skip
def test_a_sample_or_a_point_alone_gives_what_it_gives_among_others(name: str) -> None:
    inputs = Inputs("cpu", sizes={1: 3}, training=False)
    together = call(name, inputs)
    lead, number = (1, 3) if any(size == 1 for size, _ in inputs.made) else (5, 5)
    compared = 0
    for row in range(number):
        alone = [x[row : row + 1] if size == lead else x for size, x in inputs.made]
        results = call(name, Inputs("cpu", training=False, replayed=iter(alone)))
        for one, of_all in zip(results, together, strict=True):
            if of_all.shape[:1] == (number,) and one.shape[:1] == (1,):
                assert_same([one], [of_all[row : row + 1]], 1e-4)
                compared += 1
    assert compared


@names(
    crown, geometry, icosphere, losses, sphere, sweep,
    without=f"{TABLES} icosphere_within Views photo_consistency photo_consistency_share semi_global_sweep",
)  # fmt: skip
def test_gradients_are_those_of_finite_differences(name: str) -> None:
    inputs = Inputs("cpu", torch.float64)
    call(name, inputs)
    leaves = [x.requires_grad_() if x.is_floating_point() else x for _, x in inputs.made]

    def function(*leaves: Tensor) -> tuple[Tensor, ...]:
        results = call(name, Inputs("cpu", torch.float64, replayed=iter(leaves)))
        return tuple(x for x in results if x.requires_grad)

    assert function(*leaves)
    assert torch.autograd.gradcheck(function, leaves, fast_mode=True)


@names(*ROOMS, without="SweepTables semi_global_tables")  # at edges several triangles are right
def test_every_mode_of_kernels_gives_the_numbers_of_the_reference(name: str) -> None:
    with kernels("reference"):
        expected = call(name, Inputs("cpu"))
    for mode in ("plain", "graph"):
        with kernels(mode):
            assert_same(call(name, Inputs("cpu")), expected, 1e-4)


MISTAKES: dict[str, tuple[Callable[[Tensor], Any], type[Exception], str]] = {
    "an array of numpy": (
        Tensor.numpy,
        ArgumentTypeError,
        """CameraRig.2 coverage.1 sample_sphere.1 rotation_from_yaw_pitch_roll.0 Cubemap.1
        Equirectangular.1 from_subdivision_order.0 to_subdivision_order.0 healpix_pool.0 healpix_upsample.0
        cube_from_layout.0 DepthHint.0 DepthHint.1 collate_samples.0""",
    ),
    "numbers of another type": (
        lambda x: x.long() if x.is_floating_point() else x.float(),
        ArgumentError,
        """CameraRig.2 sample_sphere.0 rotation_from_yaw_pitch_roll.0 Crown.0 to_crown.0 ToCrown.0
        crown_relu.0 CrownAvgPool2d.0 CrownMaxPool2d.0 crown_avg_pool2d.0 crown_max_pool2d.0 from_subdivision_order.0
        to_subdivision_order.0 icosphere_normals.0 icosphere_pool.1 depth_index_huber.2 solid_angle_mean.2 depth_error.2
        depth_index_error.2 stereo_error.2 DepthNetwork.0 TangentImages.1 healpix_pool.0 healpix_upsample.0 CubePad2d.0
        EquirectangularPad2d.0 cube_pad.0 equirectangular_pad.0 cube_from_layout.0 cube_to_layout.0 make_seamless.0
        DepthHint.0 DepthHint.1 depth_from_index.0 inverse_depth_from_index.0 collate_samples.0 icosphere_within.0
        SphereSegmenter.0 SphereClassifier.0 Views.0""",
    ),
    "one number more": (
        lambda x: torch.cat((x, x[..., :1]), -1),
        ShapeError,
        """CameraRig.2 coverage.1 rotation_from_yaw_pitch_roll.0 bilinear_sample.0 bilinear_sample.2 bilinear_sample.4
        directions_from_longitude_latitude.0 directions_from_longitude_latitude.1 DepthNetwork.0 EquirectangularPad2d.0
        equirectangular_pad.0 make_seamless.0 views.0 SphereConv2d.0 sphere_conv2d.0 sphere_conv2d.1 Aggregation.0
        Concatenation.0 MeanVariance.0 SweepVolume.0 DepthHint.0 correlation_evidence.0 depth_from_index.0
        index_from_depth.0 index_from_inverse_depth.0 inverse_depth_from_index.0 semi_global_costs.0 soft_argmax.0
        soft_argmax_confidence.0 collate_samples.0""",
    ),
}
"""A change of a tensor, the error that it is told by, and what it is not asked of: the tensors of a call, from 0."""


@pytest.mark.parametrize("mistake", MISTAKES)
@pytest.mark.parametrize("name", [name for name in CALLS if name not in f"{TABLES} random_rotations".split()])
def test_another_type_or_shape_of_a_tensor_is_told_by_the_argument(name: str, mistake: str) -> None:
    change, error, free = MISTAKES[mistake]
    inputs = Inputs("cpu")
    call(name, inputs)
    assert inputs.made
    for index in range(len(inputs.made)):
        if f"{name}.{index}" not in free.split():
            changed: list[Any] = [x for _, x in inputs.made]
            changed[index] = change(changed[index])
            with pytest.raises(error, match=r"^[\w ]+(\['cam1'\])?: .*, got "):
                call(name, Inputs("cpu", replayed=iter(changed)))
