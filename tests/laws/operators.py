# SPDX-License-Identifier: Apache-2.0
"""The table of public functions, modules and classes of tensors: a call of each, for ``tests/test_operator_laws.py``.

A new name is one line in ``CALLS``, and gets every law, or in ``EXCEPTIONS`` with the reason why it has none.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor, nn

from sphericalvision import cameras, crown, data, geometry, icosphere, losses, metrics, models, sphere, sweep
from sphericalvision.cameras import Camera, CameraRig
from tests.laws.cameras import MODELS

LEVEL = 2
V = 162
SIZE = (96, 112)


@dataclass
class Inputs:
    """What the calls below take their tensors from: ``m`` makes them, or replays those of an earlier call.

    Attributes:
        device: where they are; on a CPU numbers are in [0, 1), the same in every call.
        dtype: of numbers.
        sizes: what the first size of a tensor is changed to: 1 is that of a sample, 5 that of points.
        training: the mode of modules.
        replayed: tensors to be used in place of new ones.
        made: all tensors so far, with the first size that was asked for.
    """

    device: str = "meta"
    dtype: torch.dtype = torch.float32
    sizes: Mapping[int, int] = field(default_factory=dict)
    training: bool = True
    replayed: Iterator[Any] | None = None
    made: list[tuple[int, Tensor]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.generator = torch.Generator().manual_seed(0)


INPUTS = [Inputs()]
"""The last one is in use."""


def call(name: str, inputs: Inputs) -> list[Tensor]:
    """Tensors that the call of a name returns."""
    INPUTS.append(inputs)
    torch.manual_seed(0)  # weights of modules
    try:
        return list(tensors(CALLS[name]()))
    finally:
        INPUTS.pop()


def m(*size: int, dtype: torch.dtype = torch.float32) -> Any:
    inputs = INPUTS[-1]
    if inputs.replayed is not None:
        return next(inputs.replayed)
    sizes = (inputs.sizes.get(size[0], size[0]), *size[1:])
    dtype = inputs.dtype if dtype == torch.float32 else dtype
    if dtype.is_floating_point and inputs.device == "cpu":
        values = torch.rand(*sizes, generator=inputs.generator).to(dtype)
    else:
        values = torch.zeros(*sizes, dtype=dtype, device=inputs.device)
    inputs.made.append((size[0], values))
    return values


def rotation() -> Tensor:
    return geometry.transform_from_axis_angle(m(3), m(3))[:3, :3]


def ids(*size: int) -> Tensor:
    return m(*size, dtype=torch.long)


def mask(*size: int) -> Tensor:
    return m(*size, dtype=torch.bool)


def camera(name: str = "equidistant") -> Camera:
    return MODELS[name](1.0).to(INPUTS[-1].device)


def rig() -> CameraRig:
    return cameras.ring_rig(4, image_size=(24, 24)).to(INPUTS[-1].device)


def tables() -> Any:
    return (
        sweep.SphereSweep(LEVEL, 8, 0.5)
        .tables(cameras.ring_rig(4, image_size=(24, 24)))
        .to(INPUTS[-1].device)
    )


def ico() -> icosphere.Icosphere:
    return icosphere.Icosphere(LEVEL, device=INPUTS[-1].device)


def panorama() -> sphere.Equirectangular:
    return sphere.Equirectangular(8, 16, device=INPUTS[-1].device)


def values() -> Tensor:
    return m(1, 3, V)


def volume() -> Tensor:
    return m(1, 3, 4, V)


def flat() -> crown.Crown:
    return crown.to_crown(values())


def thick() -> crown.Crown:
    return crown.to_crown(volume())


def placed(module: nn.Module) -> Any:
    """A module where the inputs are, in their mode and precision."""
    module = module.to(INPUTS[-1].device).train(INPUTS[-1].training)
    return module.double() if INPUTS[-1].dtype == torch.float64 else module


def run(module: nn.Module, *inputs: Any) -> Any:
    return placed(module)(*inputs)


def called(function: str, case: str, places: Tensor) -> Any:
    """A function of a camera model with the intrinsics of a camera, by the names of its arguments."""
    call, lens = getattr(cameras, function), camera(case)
    known = {"direct_polynomial": "polynomial", "coefficients": "polynomial"}
    names = {name: known.get(name, name) for name in list(inspect.signature(call).parameters)[1:]}
    return call(places, **{name: getattr(lens, of) for name, of in names.items() if hasattr(lens, of)})


def of_model(name: str, case: str) -> dict[str, Callable[[], Any]]:
    """Calls of a camera model: its class, and the pair of functions behind it."""
    words = "".join(f"_{letter.lower()}" if letter.isupper() else letter for letter in name)
    words = words.replace("_o_cam", "_ocam")
    return {
        f"{name}Camera": lambda: (
            camera(case).project(m(5, 3)),
            camera(case).unproject(m(5, 2)),
            camera(case).sample(m(3, *camera(case).image_size), m(5, 3)),
        ),
        f"project{words}": lambda: called(f"project{words}", case, m(5, 3)),
        f"unproject{words}": lambda: called(f"unproject{words}", case, m(5, 2)),
    }


MODELS_OF = {
    type(make(1.0)).__name__.removesuffix("Camera"): name
    for name, make in reversed(MODELS.items())  # of several the first
    if name != "equirectangular"
}


def updated(metric: Any, *inputs: Tensor) -> Any:
    metric = metric.to(INPUTS[-1].device)
    metric.update(*inputs)
    return metric.compute()


CALLS: dict[str, Callable[[], Any]] = {
    # cameras
    **{name: call for model, case in MODELS_OF.items() for name, call in of_model(model, case).items()},
    "EquirectangularCamera": lambda: (
        camera("equirectangular").project(m(5, 3)),
        camera("equirectangular").unproject(m(5, 2)),
    ),
    "project_equirectangular": lambda: cameras.project_equirectangular(m(5, 3), (48, 96)),
    "unproject_equirectangular": lambda: cameras.unproject_equirectangular(m(5, 2), (48, 96)),
    "Camera": lambda: camera().pixel_grid(),
    "CameraModule": lambda: run(cameras.CameraModule(MODELS["equidistant"](1.0)), m(5, 3)),
    "CameraRig": lambda: (
        rig().project(m(5, 3)),
        rig().points_seen(m(5, 3), m(2)),
        rig().rotated(tilt=0.1, rotation=rotation()).world_from_camera,
        rig().radius,
        rig().max_angles,
    ),
    "Projection": lambda: camera().project(m(5, 3)),
    "Unprojection": lambda: camera().unproject(m(5, 2)),
    "coverage": lambda: cameras.coverage(rig(), m(5, 3), m(2)),
    "seen_by": lambda: cameras.seen_by(rig(), m(5, 3), m(5)),
    "depth_from_z": lambda: cameras.depth_from_z(m(*SIZE), camera()),
    "z_from_depth": lambda: cameras.z_from_depth(m(*SIZE), camera()),
    "points_from_depth": lambda: cameras.points_from_depth(m(*SIZE), camera()),
    "remap": lambda: cameras.remap(m(3, *SIZE), camera(), camera("pinhole"), rotation()),
    "remap_mask": lambda: cameras.remap_mask(camera(), camera("pinhole")),
    "Remap": lambda: cameras.Remap(camera(), camera("pinhole"))(m(3, *SIZE)),
    "sample_sphere": lambda: cameras.sample_sphere(rig(), [m(3, 24, 24)] * 4, m(5, 3)),
    "undistort": lambda: cameras.undistort(m(3, *SIZE), camera(), 1.5),
    "undistorted_camera": lambda: cameras.undistorted_camera(camera(), 1.5).focal_length,
    "rotation_from_yaw_pitch_roll": lambda: cameras.rotation_from_yaw_pitch_roll(m(2, 3)),
    # crown
    "Crown": flat,
    "to_crown": flat,
    "from_crown": lambda: crown.from_crown(flat()),
    "ToCrown": lambda: run(crown.ToCrown(), values()),
    "FromCrown": lambda: run(crown.FromCrown(), flat()),
    "exchange": lambda: crown.exchange(flat()),
    "CrownExchange": lambda: run(crown.CrownExchange(), flat()),
    "crown_relu": lambda: crown.crown_relu(flat()),
    "CrownPointwise": lambda: run(crown.CrownPointwise(nn.Conv2d(3, 4, 1)), flat()),
    "CrownConv2d": lambda: run(crown.CrownConv2d(3, 4), flat()),
    "CrownConv3d": lambda: run(crown.CrownConv3d(3, 4), thick()),
    "crown_conv2d": lambda: crown.crown_conv2d(flat(), m(4, 3, 7)),
    "crown_conv3d": lambda: crown.crown_conv3d(thick(), m(4, 3, 21)),
    "CrownConvNorm2d": lambda: run(crown.CrownConvNorm2d(3, 4, relu=True), flat()),
    "CrownConvNorm3d": lambda: run(crown.CrownConvNorm3d(3, 4, relu=True), thick()),
    "CrownBlock3d": lambda: run(crown.CrownBlock3d(3, 4, 3), volume()),
    "crown_block3d": lambda: crown.crown_block3d(
        volume(),
        placed(crown.CrownConvNorm3d(3, 4, relu=True)),
        placed(crown.CrownConv3d(4, 3)),
    ),
    "CrownBatchNorm2d": lambda: run(crown.CrownBatchNorm2d(3), flat()),
    "CrownBatchNorm3d": lambda: run(crown.CrownBatchNorm3d(3), thick()),
    "CrownInstanceNorm2d": lambda: run(crown.CrownInstanceNorm2d(3), flat()),
    "CrownInstanceNorm3d": lambda: run(crown.CrownInstanceNorm3d(3), thick()),
    "CrownAvgPool2d": lambda: run(crown.CrownAvgPool2d(), flat()),
    "CrownMaxPool2d": lambda: run(crown.CrownMaxPool2d(), flat()),
    "crown_avg_pool2d": lambda: crown.crown_avg_pool2d(flat()),
    "crown_max_pool2d": lambda: crown.crown_max_pool2d(flat()),
    "CrownUpsample": lambda: run(crown.CrownUpsample(), flat()),
    "crown_upsample": lambda: crown.crown_upsample(flat()),
    "HexConv2d": lambda: run(crown.HexConv2d(3, 4, orientation="north", level=LEVEL), values()),
    "HexConv3d": lambda: run(crown.HexConv3d(3, 4), volume()),
    "HexLiftConv2d": lambda: run(crown.HexLiftConv2d(3, 4, level=LEVEL), values()),
    "HexGroupConv2d": lambda: run(crown.HexGroupConv2d(3, 4, level=LEVEL), m(1, 3, 6, V)),
    "hex_lift_conv2d": lambda: crown.hex_lift_conv2d(values(), m(4, 3, 7)),
    "hex_group_conv2d": lambda: crown.hex_group_conv2d(m(1, 3, 6, V), m(4, 3, 6, 7)),
    "hex_conv2d": lambda: crown.hex_conv2d(values(), m(4, 3, 7)),
    "hex_conv3d": lambda: crown.hex_conv3d(volume(), m(4, 3, 21)),
    "north_fraction": lambda: crown.north_fraction(LEVEL, device=INPUTS[-1].device),
    # geometry
    "angle_from_axis": lambda: geometry.angle_from_axis(m(5, 3)),
    "bilinear_sample": lambda: (
        geometry.bilinear_sample(m(3, 4, 8), m(5, 2), wrap_longitude=True),
        geometry.bilinear_sample(m(3, 4, 8), m(5, 2)),
        geometry.bilinear_sample(m(1, 3, 4, 8), m(1, 4, 2)),
    ),
    "directions_from_longitude_latitude": lambda: geometry.directions_from_longitude_latitude(m(5), m(5)),
    "longitude_latitude_from_directions": lambda: geometry.longitude_latitude_from_directions(m(5, 3)),
    "invert_transform": lambda: geometry.invert_transform(m(4, 4)),
    "normalize": lambda: geometry.normalize(m(5, 3)),
    "transform_from_axis_angle": lambda: geometry.transform_from_axis_angle(m(5, 3), m(5, 3)),
    "transform_from_quaternion": lambda: geometry.transform_from_quaternion(m(5, 4), m(5, 3)),
    "transform_points": lambda: geometry.transform_points(m(4, 4), m(5, 3)),
    # icosphere
    "Icosphere": lambda: (
        ico().locate(m(5, 3)),
        ico().nearest(m(5, 3)),
        ico().sample(values(), m(5, 3)),
        ico().solid_angles,
        ico().neighbors,
    ),
    "IcospherePool": lambda: run(icosphere.IcospherePool(LEVEL), values()),
    "IcosphereUpsample": lambda: run(icosphere.IcosphereUpsample(LEVEL), values()),
    "from_subdivision_order": lambda: icosphere.from_subdivision_order(values()),
    "to_subdivision_order": lambda: icosphere.to_subdivision_order(values()),
    "icosphere_edges": lambda: icosphere.icosphere_edges(LEVEL, INPUTS[-1].device),
    "icosphere_faces": lambda: icosphere.icosphere_faces(LEVEL, INPUTS[-1].device),
    "icosphere_neighbors": lambda: icosphere.icosphere_neighbors(LEVEL, INPUTS[-1].device),
    "icosphere_normals": lambda: icosphere.icosphere_normals(m(V, 3)),
    "icosphere_pool": lambda: (icosphere.icosphere_pool(values()), icosphere.icosphere_pool(values(), "max")),
    "icosphere_solid_angles": lambda: icosphere.icosphere_solid_angles(LEVEL, device=INPUTS[-1].device),
    "icosphere_upsample": lambda: icosphere.icosphere_upsample(values()),
    "icosphere_vertices": lambda: icosphere.icosphere_vertices(LEVEL, device=INPUTS[-1].device),
    "icosphere_voronoi_solid_angles": lambda: icosphere.icosphere_voronoi_solid_angles(
        LEVEL, device=INPUTS[-1].device
    ),
    "icosphere_rings": lambda: icosphere.icosphere_rings(LEVEL, 1, ids(3)),
    "icosphere_within": lambda: icosphere.icosphere_within(m(5, 3), 0.3, LEVEL),
    "locate": lambda: icosphere.locate(m(5, 3), LEVEL),
    # losses and metrics
    "depth_index_huber": lambda: losses.depth_index_huber(m(1, V), m(1, V), mask(1, V)),
    "solid_angle_mean": lambda: losses.solid_angle_mean(values(), m(V), mask(1, 3, V)),
    "angular_error": lambda: metrics.angular_error(m(5, 3), m(5, 3)),
    "depth_error": lambda: metrics.depth_error(m(1, V), m(1, V), mask(1, V)),
    "depth_index_error": lambda: metrics.depth_index_error(m(1, V), m(1, V), 8, mask(1, V)),
    "stereo_error": lambda: metrics.stereo_error(m(1, V), m(1, V), mask(1, V)),
    "left_right_error": lambda: metrics.left_right_error(m(1, 8, 16), m(1, 8, 16)),
    "omnimvs_error": lambda: metrics.omnimvs_error(m(1, 8, 16), m(1, 8, 16)),
    "evaluation_mask": lambda: metrics.evaluation_mask(rig(), m(V, 3), m(1, V)),
    "seam_mask": lambda: metrics.seam_mask(m(V, 3)),
    # models
    "DepthNetwork": lambda: models.IcoSweepNet(4, 8, feature_channels=2).to(INPUTS[-1].device).depth(m(1, V)),
    "IcoSweepNet": lambda: run(models.IcoSweepNet(4, 8, feature_channels=2), m(1, 4, 3, 2562), rig()),
    "OmniMVS": lambda: run(
        models.OmniMVS(16, feature_channels=4, output_size=(16, 64)), m(1, 4, 1, 24, 24), rig()
    ),
    "RefinedSweepNet": lambda: run(models.RefinedSweepNet(5), m(1, 4, 3, 10242), rig()),
    "RomniStereo": lambda: run(
        models.RomniStereo(16, feature_channels=4, output_size=(16, 64)), m(1, 4, 1, 24, 24), rig()
    ),
    "SemiGlobalSweep": lambda: run(models.SemiGlobalSweep(4, 8), m(1, 4, 3, 2562), rig()),
    "ConstantDepth": lambda: run(models.ConstantDepth(4, 8), m(1, 4, 3, 2562), rig()),
    "WinnerTakesAll": lambda: run(models.WinnerTakesAll(4, 8), m(1, 4, 3, 2562), rig()),
    "SphereSegmenter": lambda: run(models.SphereSegmenter("hex", level=3, num_classes=5), m(1, 3, 642)),
    "SphereClassifier": lambda: run(models.SphereClassifier(level=3), m(1, 1, 642)),
    # sphere
    "Cubemap": lambda: sphere.Cubemap(4, device=INPUTS[-1].device).sample(m(3, 6, 4, 4), m(5, 3)),
    "Equirectangular": lambda: panorama().sample(m(3, 8, 16), m(5, 3)),
    "Healpix": lambda: sphere.Healpix(2, device=INPUTS[-1].device).sample(m(3, 48), m(5, 3)),
    "TangentImages": lambda: sphere.TangentImages(0, 4, device=INPUTS[-1].device).sample(
        m(3, 20, 4, 4), m(5, 3)
    ),
    "SphereGrid": lambda: panorama().solid_angles,
    "healpix_pool": lambda: sphere.healpix_pool(m(3, 48)),
    "healpix_upsample": lambda: sphere.healpix_upsample(m(3, 48)),
    "CubePad2d": lambda: run(sphere.CubePad2d(1), m(6, 3, 4, 4)),
    "EquirectangularPad2d": lambda: run(sphere.EquirectangularPad2d(1), m(1, 3, 8, 16)),
    "cube_pad": lambda: sphere.cube_pad(m(1, 3, 6, 4, 4), 1),
    "equirectangular_pad": lambda: sphere.equirectangular_pad(m(3, 8, 16), 1),
    "cube_from_layout": lambda: sphere.cube_from_layout(m(3, 12, 16)),
    "cube_to_layout": lambda: sphere.cube_to_layout(m(3, 6, 4, 4)),
    "make_seamless": lambda: run(sphere.make_seamless(nn.Conv2d(3, 4, 3, padding=1)), m(1, 3, 8, 16)),
    "nested_from_ring": lambda: sphere.nested_from_ring(ids(5), 2),
    "ring_from_nested": lambda: sphere.ring_from_nested(ids(5), 2),
    "resample": lambda: (
        sphere.resample(m(3, *SIZE), camera(), ico(), rotation()),
        sphere.resample(values(), ico(), panorama(), mode="area"),
    ),
    "views": lambda: sphere.views(m(3, 16, 32)).map(lambda x: x).merge(),
    "Views": lambda: sphere.Views([m(1, 1, 24, 24)] * 4, rig()).merge(panorama(), quantity="z"),
    "resample_mask": lambda: sphere.resample_mask(camera(), ico()),
    "Resample": lambda: sphere.Resample(camera(), ico())(m(3, *SIZE)),
    "SphereConv2d": lambda: run(sphere.SphereConv2d(3, 4), m(1, 3, 8, 16)),
    "sphere_conv2d": lambda: sphere.sphere_conv2d(m(1, 3, 8, 16), m(4, 3, 3, 3)),
    "sphere_taps": lambda: sphere.sphere_taps((8, 16), device=torch.device(INPUTS[-1].device)),
    # sweep
    "Aggregation": lambda: run(sweep.MeanVariance(5), sweep.sphere_sweep(m(1, 4, 5, V), tables())),
    "Concatenation": lambda: run(sweep.Concatenation(5, 4), sweep.sphere_sweep(m(1, 4, 5, V), tables())),
    "MeanVariance": lambda: run(sweep.MeanVariance(5), sweep.sphere_sweep(m(1, 4, 5, V), tables())),
    "SphereSweep": lambda: run(sweep.SphereSweep(LEVEL, 8, 0.5), m(1, 4, 5, V), rig()),
    "PanoramaSweep": lambda: run(sweep.PanoramaSweep((8, 16), 8, 0.5), m(1, 4, 5, 12, 12), rig()),
    "SweepTables": tables,
    "SweepVolume": lambda: sweep.sphere_sweep(m(1, 4, 5, V), tables()),
    "sphere_sweep": lambda: sweep.sphere_sweep(m(1, 4, 5, V), tables(), mask(4, V)),
    "DepthEstimate": lambda: sweep.depth_estimate(m(1, 8, V), mask(1, 4, 8, V)),
    "DepthHint": lambda: sweep.DepthHint(m(1, V), m(1, V)).coarser(),
    "depth_estimate": lambda: sweep.depth_estimate(m(1, 8, V), mask(1, 4, 8, V)),
    "correlation_evidence": lambda: sweep.correlation_evidence(m(1, 4, 3, V), tables()),
    "depth_from_index": lambda: sweep.depth_from_index(m(5), 8, 0.5),
    "index_from_depth": lambda: sweep.index_from_depth(m(5), 8, 0.5),
    "index_from_inverse_depth": lambda: sweep.index_from_inverse_depth(m(5), 8, 0.5),
    "inverse_depth_from_index": lambda: sweep.inverse_depth_from_index(m(5), 8, 0.5),
    "inverse_depth_hypotheses": lambda: sweep.inverse_depth_hypotheses(8, 0.5, device=INPUTS[-1].device),
    "photo_consistency": lambda: sweep.photo_consistency(m(1, 4, 3, V), rig(), 8, 0.5),
    "photo_consistency_share": lambda: sweep.photo_consistency_share(m(1, V), m(1, 4, 3, V), rig(), 8, 0.5),
    "semi_global_costs": lambda: sweep.semi_global_costs(m(1, 4, 3, V), tables()),
    "semi_global_smoothing": lambda: sweep.semi_global_smoothing(m(1, 8, V), 0.1, 1.0),
    "semi_global_sweep": lambda: sweep.semi_global_sweep(m(1, 4, 3, V), rig(), 8, 0.5),
    "semi_global_tables": lambda: sweep.semi_global_tables(rig(), 8, 0.5, LEVEL),
    "soft_argmax": lambda: sweep.soft_argmax(m(8, V)),
    "soft_argmax_confidence": lambda: sweep.soft_argmax_confidence(m(8, V)),
    # data
    "random_rotations": lambda: data.random_rotations(3).to(INPUTS[-1].device),
    "collate_samples": lambda: data.collate_samples([{"images": values()}] * 2)["images"],
}
FILES = "reads or writes files"
NUMBERS = "returns numbers of Python, for which it looks at the tensors"
PICTURE = "returns a picture, a mesh or points of numpy"
SCENE = "rays that met something are picked by what they met"
FIT = "fits by least squares, and stops when the numbers do not change any more"
CLASS = "a name for errors, types or a registry, without tensors"
DRAWN = "draws numbers on the CPU, the same on every device, and looks at them"
EXCEPTIONS: dict[str, str] = {
    **dict.fromkeys(("read_camera", "read_cameras", "read_rig", "save_camera", "save_rig"), FILES),
    **dict.fromkeys(("read_mesh_scene", "write_omnistereo"), FILES),
    **dict.fromkeys(("OmniStereoDataset", "available_weights", "pretrained", "load_weights"), FILES),
    **dict.fromkeys(("load_reference_checkpoint", "save_weights", "save_point_cloud"), FILES),
    "load_romnistereo_checkpoint": FILES,
    "read_points": FILES,
    "truth_from_points": "searches neighbours by scipy, on the CPU",
    **dict.fromkeys(("field_of_view", "overlap", "level_from_num_vertices", "num_icosphere_vertices"), NUMBERS),
    **dict.fromkeys(("AprilGrid", "Charuco", "Checkerboard", "read_board"), "looks at images by OpenCV"),
    **dict.fromkeys(("compare_cameras", "rectified_pairs", "RectifiedPair"), NUMBERS),
    **dict.fromkeys(("calibrate_camera", "calibrate_rig", "convert", "fit_inverse_polynomial"), FIT),
    **dict.fromkeys(("refine", "refine_rig"), FIT),
    **dict.fromkeys(("Trajectory", "read_trajectory"), "features and files"),
    **dict.fromkeys(("PhotometricCalibration", "align_rig", "align_rig_direct", "calibrate_photometry"), FIT),
    **dict.fromkeys(("OwnBody", "Preparation", "find_own_body"), "looks at images by OpenCV"),
    **dict.fromkeys(("from_kornia", "to_kornia"), "looks whether the other library's class can hold the numbers"),
    **dict.fromkeys(("register_camera", "register_network", "register_aggregation"), CLASS),
    **dict.fromkeys(("ArgumentError", "ArgumentTypeError", "FileFormatError", "MissingCompilerError"), CLASS),
    **dict.fromkeys(("MissingFileError", "ShapeError", "SphericalVisionError"), CLASS),
    **dict.fromkeys(("kernels", "reference_kernels"), CLASS),
    **dict.fromkeys(("set_kernel_options", "state_dict_from_reference", "Compose"), CLASS),
    **dict.fromkeys(("Scene", "MeshScene", "make_scene", "ray_depth"), SCENE),
    **dict.fromkeys(("render_camera", "render_directions", "render_rig", "ray_labels"), SCENE),
    "SURFACE_LABELS": CLASS,
    "SampleView": CLASS,
    "World": SCENE,
    "WorldSamples": SCENE,
    **dict.fromkeys(("PhotometricAugmentation", "RandomShift", "RandomSphereRotation", "RandomYaw"), DRAWN),
    "RotateFivefold": DRAWN,
    **dict.fromkeys(("RotateFisheye", "ToSphere"), "keeps tables of a rig, which it recognises by its numbers"),
    **dict.fromkeys(("Depth", "DepthImage", "Hint", "Predictor"),
                    "looks for the nearest depth, and gives numbers to people"),
    **dict.fromkeys(("ByRegion", "DepthError", "DepthIndexError", "LeftRightError", "OmniMVSError", "StereoError"),
                    "leaves out images without a valid point; the functions behind it run"),
    **dict.fromkeys(("SolidAngleIoU", "SolidAngleMean"), "leaves out what no mask counts, by its numbers"),
    **dict.fromkeys(("straighten", "straighten_rig"), "takes a calibration apart, once, by its numbers"),
    "ring_rig": "makes a rig on the CPU; `.to` moves it",
    "TriangleLocator": "its tables are made for the numbers of a level, on a device that has some",
    **dict.fromkeys(("angle_map", "coverage_panorama", "depth_panorama", "depth_to_color"), PICTURE),
    **dict.fromkeys(("error_panorama", "error_to_color", "icosphere_mesh"), PICTURE),
    **dict.fromkeys(("rgb_panorama", "rig_picture", "sheet", "sphere_mesh"), PICTURE),
}  # fmt: skip


def tensors(found: Any) -> Iterable[Tensor]:
    """All tensors in a result."""
    if isinstance(found, Tensor):
        yield found
    elif isinstance(found, Mapping):
        for value in found.values():
            yield from tensors(value)
    elif isinstance(found, tuple | list):
        for value in found:
            yield from tensors(value)
