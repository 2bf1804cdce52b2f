# SPDX-License-Identifier: Apache-2.0
"""Predictor: any form of images gives the same depth, which is the network's; mistakes are told."""

from __future__ import annotations

import copy
import pickle
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from multiprocessing.reduction import ForkingPickler
from typing import Any

import pytest
import torch
from torch import Tensor

import sphericalvision
from sphericalvision import Predictor
from sphericalvision.cameras import CameraRig, PinholeCamera, ring_rig
from sphericalvision.capture import Depth
from sphericalvision.capture import predictor as predictor_module
from sphericalvision.capture.export import RigProgram
from sphericalvision.capture.predictor import threads_kept
from sphericalvision.capture.preparation.nearest import frames_of
from sphericalvision.capture.preparation.preparation import Preparation
from sphericalvision.core import ArgumentError
from sphericalvision.data import ToSphere
from sphericalvision.models import (
    DepthNetwork,
    IcoSweepNet,
    OmniMVS,
    SemiGlobalSweep,
    WinnerTakesAll,
    save_weights,
)
from sphericalvision.scenes import make_scene, ray_depth, render_rig
from sphericalvision.scenes.disturbances import vignetted
from sphericalvision.sweep import DepthEstimate

SIZE = (48, 56)
Images = dict[str, Tensor]


@pytest.fixture(scope="module")
def rig() -> CameraRig:
    return ring_rig(4, image_size=SIZE)


@pytest.fixture(scope="module")
def images(rig: CameraRig) -> Images:
    """A room in 8 bits, so that all forms hold the same numbers."""
    rendered = render_rig(make_scene("room", seed=1), rig)
    return {name: (image * 255).round() / 255 for name, image in rendered.items()}


@pytest.fixture(scope="module")
def predictor(rig: CameraRig) -> Predictor:
    return Predictor(rig, SemiGlobalSweep(4, 8, depth_coarsening=1), min_depth=0.55)


def test_it_is_the_network_on_images_on_the_sphere(rig: CameraRig, images: Images) -> None:
    torch.manual_seed(0)
    net = IcoSweepNet(3, 6, feature_channels=2).eval()
    depth = Predictor(rig, net, min_depth=0.4)(images)
    to_sphere = ToSphere(3, antialias=True)
    on_sphere, seen = to_sphere.images(images, rig), to_sphere.seen(rig)
    with torch.inference_mode():
        expected = net.with_changes(min_depth=0.4).predict(on_sphere[None], rig, seen[None])
    torch.testing.assert_close(depth.index, expected.index[0])
    torch.testing.assert_close(depth.confidence, expected.confidence[0])
    assert torch.equal(depth.seen, expected.seen[0])
    torch.testing.assert_close(depth.depth * depth.inverse_depth, torch.ones_like(depth.depth))
    assert depth.min_depth == 0.4
    assert depth.depth.min() >= 0.4 - 1e-5


@pytest.mark.parametrize(
    "form",
    [
        lambda image: (image.movedim(0, -1) * 255).round().byte().numpy(),
        lambda image: (image.double() * 65535).round().numpy().astype(">u2"),
        lambda image: image.double().numpy()[:, ::-1][:, ::-1],  # strides that torch does not take
    ],
)
def test_all_forms_of_images_are_the_same_images(predictor: Predictor, images: Images, form: object) -> None:
    expected = predictor(images)
    found = predictor({name: form(image) for name, image in images.items()})  # type: ignore[operator]
    torch.testing.assert_close(found.index, expected.index, atol=1e-4, rtol=0)


@pytest.mark.parametrize("grey", [False, True])
def test_a_batch_is_its_frames(predictor: Predictor, images: Images, grey: bool) -> None:
    other = {name: image.flip(-1) for name, image in images.items()}
    batch = {name: torch.stack((images[name], other[name])) for name in images}
    if grey:
        batch = {name: image[:, 0] for name, image in batch.items()}
        images, other = ({n: image[0] for n, image in one.items()} for one in (images, other))
    both = predictor(batch)
    assert (len(both), both.batch_shape) == (2, (2,))
    for frame, one in enumerate((images, other)):
        alone = predictor(one)
        torch.testing.assert_close(both.select(frame).index, alone.index, atol=1e-4, rtol=0)
        torch.testing.assert_close(both.index[frame], alone.index, atol=1e-4, rtol=0)
        panoramas = both.panorama(8).depth[frame], alone.panorama(8).depth
        torch.testing.assert_close(*panoramas, rtol=1e-4, atol=1e-4)
    assert both.camera("cam1").depth.shape == (2, *SIZE)
    with pytest.raises(ArgumentError, match="select"):
        both.points()


def test_tables_are_made_once_and_threads_get_what_one_gets(rig: CameraRig, images: Images) -> None:
    made = []

    class Counting(SemiGlobalSweep):
        def tables(self, rig: CameraRig) -> object:  # type: ignore[override]
            made.append(rig)
            return super().tables(rig)

    shared = Predictor(rig, Counting(3, 8), min_depth="scene")
    frames = [{name: image.roll(shift, -1) for name, image in images.items()} for shift in range(6)]
    shared = shared.with_changes(min_depth=shared.nearest_depth(frames[:1]))
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(shared, frames))
    assert len(made) == 1
    for depth, frame in zip(found, frames, strict=True):
        assert torch.equal(depth.index, shared(frame).index)


@pytest.mark.parametrize("weights", [None, WinnerTakesAll(3, 8)], ids=["shipped", "sweep"])
def test_a_predictor_is_copied_and_pickled(
    rig: CameraRig, images: Images, weights: DepthNetwork | None
) -> None:
    one = Predictor(rig, weights, level=5 if weights is None else None, min_depth=0.55)
    before = [pickle.loads(pickle.dumps(one)), copy.copy(one), copy.deepcopy(one)]
    expected = one(images).index
    for other in (*before, pickle.loads(pickle.dumps(one)), copy.deepcopy(one)):
        assert torch.equal(other(images).index, expected)


class _Frames(torch.utils.data.Dataset[Tensor]):
    def __init__(self, predictor: Predictor, images: Images) -> None:
        self.predictor, self.images = predictor, images

    def __len__(self) -> int:
        return 2

    def __getitem__(self, number: int) -> Tensor:
        return self.predictor({name: image.roll(number, -1) for name, image in self.images.items()}).index


@pytest.mark.slow
@pytest.mark.parametrize("start", ["spawn", "fork"])
def test_workers_predict(predictor: Predictor, images: Images, start: str) -> None:
    frames = _Frames(predictor, images)
    options = {"batch_size": None, "num_workers": 1, "multiprocessing_context": start}
    for found, expected in zip(torch.utils.data.DataLoader(frames, **options), frames, strict=False):
        torch.testing.assert_close(found, expected)


def test_to_another_process_it_travels_without_a_file_for_each_tensor(
    predictor: Predictor, images: Images, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A process that a fork server starts takes 253 of them."""

    def shared(*_: object) -> None:
        raise AssertionError("a tensor was shared as a file")

    monkeypatch.setitem(ForkingPickler._extra_reducers, torch.Tensor, shared)
    arrived = ForkingPickler.loads(ForkingPickler.dumps(predictor))
    assert torch.equal(arrived(images).index, predictor(images).index)
    with pytest.raises(AssertionError, match="shared as a file"):
        ForkingPickler.dumps(torch.ones(1))


@pytest.mark.parametrize("cores", [1, 2])
def test_calls_run_side_by_side_where_there_are_cores_for_both(
    rig: CameraRig, images: Images, cores: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    inside, most = [0], [0]

    class Slow(SemiGlobalSweep):
        def predict(self, *arguments: Any) -> DepthEstimate:
            inside[0] += 1
            most[0] = max(most[0], inside[0])
            time.sleep(0.1)
            end = time.monotonic() + 10
            while most[0] < cores and time.monotonic() < end:  # on a busy machine the other call may be late
                time.sleep(0.01)
            inside[0] -= 1
            return super().predict(*arguments)

    monkeypatch.setattr("sphericalvision.capture.predictor.available_cores", lambda: cores)
    monkeypatch.setattr(torch, "get_num_threads", lambda: 1)
    predictor = Predictor(rig, Slow(3, 8), min_depth=0.5)
    with ThreadPoolExecutor(2) as pool:
        found = list(pool.map(predictor, [images] * 2))
    assert most == [cores]
    assert torch.equal(found[0].index, found[1].index)


def test_a_call_takes_no_more_threads_than_the_process_has_cores_and_tables_take_one(
    rig: CameraRig, images: Images, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Counting(SemiGlobalSweep):
        def tables(self, rig: CameraRig) -> Any:
            of_tables.append(torch.get_num_threads())
            return super().tables(rig)

        def predict(self, *arguments: Any) -> DepthEstimate:
            counts.append(torch.get_num_threads())
            return super().predict(*arguments)

    counts: list[int] = []
    of_tables: list[int] = []
    monkeypatch.setattr("sphericalvision.capture.predictor.available_cores", lambda: 1)
    predictor, other = (Predictor(rig, Counting(3, 8), min_depth=0.5) for _ in range(2))
    with threads_kept():
        torch.set_num_threads(2)
        monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
        predictor(images)
        assert torch.get_num_threads() == 2
        monkeypatch.setenv("OMP_NUM_THREADS", "2")
        other(images)
        assert torch.get_num_threads() == 2
    assert counts == [1, 2]
    assert of_tables == [1, 1]


def test_what_a_first_call_makes_can_be_trained(rig: CameraRig, images: Images) -> None:
    predictor = Predictor(rig, IcoSweepNet(3, 6, feature_channels=2), min_depth=0.4)
    predictor(images)
    net = predictor.network.train()
    net(ToSphere(3).images(images, rig)[None], predictor.pipeline.tables).sum().backward()
    assert all(parameter.grad is not None for parameter in net.parameters())


def test_the_nearest_depth_is_found_scaled_or_given(images: Images) -> None:
    small = ring_rig(4, radius=0.05, image_size=(96, 96))
    scene = make_scene("hall", seed=3)
    seen = render_rig(scene, small, 2)
    net = SemiGlobalSweep(4, 8, min_depth=0.6)
    found = Predictor(small, net)
    assert found.min_depth is None
    with pytest.raises(ArgumentError, match="first images"):
        _ = found.network
    depth = found(seen)
    truth = ray_depth(scene, small.center, depth.directions)
    assert 0.3 < depth.min_depth < truth.quantile(0.02)
    assert found.min_depth == depth.min_depth == found.network.min_depth
    assert Predictor(small, net, min_depth=None).min_depth == pytest.approx(0.6 * 0.05 / 0.2)
    net.trained_radius = 0.1
    assert Predictor(small, net, min_depth=None).min_depth == pytest.approx(0.6 * 0.05 / 0.1)
    assert Predictor(small, net, min_depth=2).min_depth == 2.0


@pytest.mark.parametrize("metres", [550, 0.0005])
def test_a_nearest_hypothesis_that_no_rig_tells_is_asked_about(rig: CameraRig, metres: float) -> None:
    with pytest.warns(UserWarning, match=r"min_depth: .* radii of the rig"):
        Predictor(rig, SemiGlobalSweep(3, 8), min_depth=metres)


class _Anywhere(SemiGlobalSweep):
    """Stands for a network that was trained with rigs of many radii."""

    min_depth_follows = "training"


def test_trained_with_rigs_of_many_radii_the_nearest_depth_stays_unless_the_scene_is_of_another_size() -> (
    None
):
    net = _Anywhere(4, 8, min_depth=0.55)
    rig = ring_rig(4, radius=0.1, image_size=(96, 96))
    room = render_rig(make_scene("room", seed=3), rig, 2)
    assert Predictor(rig, net, min_depth=None).min_depth == 0.55
    assert Predictor(rig, net).nearest_depth([room]) == 0.55
    assert Predictor(rig, net, min_depth="scene").nearest_depth([room]) != 0.55
    for k in (8.0, 0.1):
        frame = render_rig(make_scene("room", seed=3, scale=k), rig.scaled(k), 2)
        found = Predictor(rig.scaled(k), net).nearest_depth([frame])
        assert found == pytest.approx(0.55 * k, rel=0.6)
    # A rig larger than any of the training: the surfaces that it sees are as far away as it is large.
    assert Predictor(rig.scaled(8), net, min_depth=None).min_depth == pytest.approx(0.55 * 0.8 / 0.4)


def test_panorama_and_cameras_show_the_surface(rig: CameraRig, images: Images) -> None:
    """With the true index in place of an estimate, every camera's depth is what a ray caster says."""
    scene = make_scene("room", seed=1)

    class Known(WinnerTakesAll):
        def predict(self, images: Tensor, rig: object, seen: Tensor | None = None) -> DepthEstimate:
            truth = ray_depth(scene, torch.zeros(3), self.grid.directions)
            index = (self.num_hypotheses - 1) * self.min_depth / truth.where(truth > 0, 1e6)
            return DepthEstimate(index[None], torch.ones(1, len(truth)), torch.ones(1, len(truth)) > 0)

    depth = Predictor(rig, Known(5, 64, depth_coarsening=0), min_depth=0.3)(images)
    panorama = depth.panorama(40)
    directions = torch.nn.functional.normalize(torch.tensor([[0.3, 0.2, 1.0], [0, 1, 0]]), dim=-1)
    inverse_depth, confidence, seen = depth.at(directions)
    expected = ray_depth(scene, rig.center, directions)
    torch.testing.assert_close(inverse_depth.reciprocal(), expected, rtol=0.02, atol=0)
    assert confidence.min() > 0.99
    assert seen.all()
    assert torch.equal(panorama.measured, panorama.depth)
    pinhole = PinholeCamera([20.0, 20.0], [11.5, 11.5], (24, 24))
    pose = rig.world_from_camera[2]
    for view, camera, place in (
        (depth.camera("cam2"), rig.cameras["cam2"], rig.world_from_camera[1]),
        (depth.camera(pinhole, pose), pinhole, pose),
        (depth.camera(pinhole), pinhole, torch.eye(4)),
    ):
        rays, looks = camera.unproject(camera.pixel_grid())
        truth = ray_depth(scene, place[:3, 3], rays.reshape(-1, 3) @ place[:3, :3].T).view(looks.shape)
        error = ((view.depth - truth).abs() / truth)[looks & (truth > 0) & truth.isfinite()]
        assert error.isfinite().float().mean() > 0.98
        assert error.nanmedian() < 0.02
        assert view.depth[~looks].isnan().all()
        assert not view.seen[~looks].any()


def test_a_camera_sees_depth_around_a_rig_that_stands_anywhere() -> None:
    """A ball of 1.1 m around a rig 5 m to the right: from its centre, by default, and from 0.3 m behind it."""
    rig = ring_rig(3, image_size=(16, 16))
    poses = rig.world_from_camera.clone()
    poses[:, 0, 3] += 5
    net, ones = WinnerTakesAll(3, 8, depth_coarsening=0), torch.ones(642)
    ahead = net.grid.vertices[:, 2] > 0.5
    depth = Depth(torch.full((642,), 3.5), ones * ahead, ahead, net, CameraRig(rig.cameras, poses), {})
    view, behind = PinholeCamera([2.0, 2.0], [1.0, 1.0], (3, 3)), torch.eye(4)
    behind[0, 3], behind[2, 3] = 5, -0.3
    for pose, expected in ((None, 1.1), (behind, 1.4)):
        found = depth.camera(view, pose)
        assert found.depth[1, 1].item() == pytest.approx(expected, abs=0.02)
        assert found.seen[1, 1]
        assert found.confidence[1, 1] == 1


@pytest.mark.parametrize("level", [3, 6])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float16])
def test_depth_is_finite_and_positive_wherever_it_is_asked_for(level: int, dtype: torch.dtype) -> None:
    """Near and infinitely far side by side, and indices off by rounding: weights of interpolation are, too."""
    rig = ring_rig(3, image_size=(16, 16))
    net = WinnerTakesAll(level, 32, min_depth=0.55, depth_coarsening=0)
    size = net.grid.num_vertices
    index = 31 * torch.randint(0, 2, (size,), generator=torch.Generator().manual_seed(0)) - 1e-5
    depth = Depth(index.to(dtype), torch.ones(size), torch.ones(size) > 0, net, rig, {})
    for found in (depth.depth, depth.panorama(128).depth, depth.camera("cam2").depth, depth.inverse_depth):
        found = found[~found.isnan()]
        assert len(found)
        assert found.isfinite().all()
        assert found.min() > 0
    nearest = depth.panorama(128).depth.min()
    assert nearest == pytest.approx(0.55, rel=1e-3)


@pytest.mark.parametrize(("frames", "looked"), [(1, [0]), (2, [0, 1]), (5, [0, 2, 4])])
def test_of_a_batch_the_first_the_middle_and_the_last_frame_are_looked_at(
    frames: int, looked: list[int]
) -> None:
    batch = torch.arange(frames).view(-1, 1, 1, 1).expand(-1, 3, 2, 2)
    chosen = frames_of({"cam1": batch, "cam2": -batch})
    assert [int(frame["cam1"][0, 0, 0]) for frame in chosen] == looked
    assert [int(frame["cam2"][0, 0, 0]) for frame in chosen] == [-frame for frame in looked]


def test_autocast_around_a_predictor_leaves_geometry_in_full_precision(
    rig: CameraRig, images: Images
) -> None:
    torch.manual_seed(0)
    net = IcoSweepNet(3, 6, feature_channels=2).eval()
    one, other = (Predictor(rig, net, min_depth=0.4) for _ in range(2))
    depth = one(images)
    verbs: list[Callable[[Depth], Tensor]] = [
        lambda d: d.panorama(16).depth,
        lambda d: d.camera("cam2").depth,
        lambda d: d.points().points,
        lambda d: d.at(torch.eye(3))[0],
    ]
    with torch.autocast("cpu", torch.bfloat16):
        inputs, _ = other.inputs(images)
        found = [verb(depth) for verb in verbs]
        other(images)
    assert torch.equal(inputs, one.inputs(images)[0])
    assert torch.equal(other(images).index, depth.index)
    for values, verb in zip(found, verbs, strict=True):
        torch.testing.assert_close(values, verb(depth), equal_nan=True, rtol=0, atol=0)


def test_a_sky_above_what_floats_has_no_depth_behind_the_rig() -> None:
    rig = ring_rig(4, image_size=(64, 64))
    depth = Predictor(rig, min_depth=0.55)(render_rig(make_scene("skies", seed=3), rig))
    assert depth.panorama(320).depth.min() > 0.5
    program = RigProgram(Predictor(rig, depth.network, min_depth=0.55), height=320)
    with torch.inference_mode():
        assert program(torch.stack(list(depth.images.values()))[None])[0].min() > 0


def test_networks_on_panoramas_are_predictors_too(rig: CameraRig, images: Images) -> None:
    net = OmniMVS(8, output_size=(8, 32), feature_channels=2, num_cameras=4, num_scales=2).eval()
    depth = Predictor(rig, net, min_depth=0.5)(images)
    assert depth.index.shape == (8, 32)
    panorama = depth.panorama(16)
    assert panorama.depth[8].isfinite().all()
    assert panorama.depth[0].isnan().all()  # beyond the latitudes that the network knows
    assert not panorama.seen[0].any()
    assert len(depth.points().points) > 0


def test_names_weights_and_methods(rig: CameraRig, images: Images, tmp_path: object) -> None:
    path = save_weights(IcoSweepNet(3, 4, feature_channels=2), f"{tmp_path}/weights.safetensors")
    assert Predictor(rig, path, min_depth=0.5)(images).index.shape == (42,)
    small = Predictor(rig, "icosweepnet-small", level=3, min_depth=0.5)
    assert type(small.network).__name__ == "IcoSweepNet"
    assert (small.network.level, small.network.num_hypotheses) == (3, 16)
    swept = Predictor(rig, path, method="semi_global", min_depth=0.5)
    assert isinstance(swept.network, SemiGlobalSweep)
    assert (swept.network.level, swept.network.num_hypotheses) == (3, 4)
    assert sphericalvision.Predictor is predictor_module.Predictor


def test_differences_between_cameras_are_taken_out(rig: CameraRig, images: Images) -> None:
    dark = {
        name: vignetted(image, rig.cameras[name], 0.6) * (0.8 if name == "cam2" else 1.0)
        for name, image in images.items()
    }
    inputs = {}
    for photometric in (False, True):
        preparation = Preparation(photometric=photometric)
        predictor = Predictor(rig, method="semi_global", level=4, min_depth=0.5, preparation=preparation)
        whole, _ = predictor.inputs(images)
        faulty, _ = predictor.inputs(dark)
        inputs[photometric] = whole, faulty
    assert torch.equal(inputs[False][0], inputs[True][0])  # nothing to take out: nothing has changed
    missed = [(faulty - whole).abs().mean().item() for whole, faulty in inputs.values()]
    assert missed[1] < missed[0] / 3


def test_each_frame_of_a_batch_has_its_own_light(rig: CameraRig, images: Images) -> None:
    dark = {name: image * (0.7 if name == "cam1" else 1.0) for name, image in images.items()}
    predictor = Predictor(rig, method="semi_global", level=4, min_depth=0.5)
    both, _ = predictor.inputs({name: torch.stack((images[name], dark[name])) for name in rig.names})
    torch.testing.assert_close(both[0], predictor.inputs(images)[0])
    torch.testing.assert_close(both[1], predictor.inputs(dark)[0])
