# SPDX-License-Identifier: Apache-2.0
"""The benchmark of depth methods: what counts, what is kept, and that killing it loses a frame at most."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from sphericalvision.capture.preparation.preparation import AS_IT_IS
from sphericalvision.core import ArgumentError
from sphericalvision.data import SampleView
from sphericalvision.icosphere import Icosphere
from sphericalvision.io.images import read_image
from sphericalvision.models import DepthNetwork, SemiGlobalSweep
from sphericalvision.models.weights.files import identity_of
from sphericalvision.recipes.datamodules.scenes import SceneDataModule
from sphericalvision.recipes.evaluation import benchmark as running
from sphericalvision.recipes.evaluation import methods, track_frames
from sphericalvision.recipes.evaluation.loop import Limit, errors_of_frame
from sphericalvision.recipes.evaluation.methods import SCALE, Method, make_method
from sphericalvision.recipes.evaluation.places import FrameTruth, PlaceErrors
from sphericalvision.recipes.evaluation.records import Record
from sphericalvision.recipes.evaluation.track_frames import Size, TrackFrame, TrackFrames, render_frame
from sphericalvision.recipes.evaluation.tracks import TRACKS, chosen_tracks
from sphericalvision.scenes.world import HELD_OUT_SEED, World
from sphericalvision.sphere.intake import Intake
from sphericalvision.sweep import DepthEstimate
from tests.recipes.tiny import TINY_BENCHMARK, Run, typed

TINY = Size(level=3, panorama_rows=8, image_rows=16, samples_per_pixel=1, preparation=AS_IT_IS)


class Oracle(DepthNetwork):
    """Knows the truth of one frame, and is off by ``offset`` hypotheses in the half of which it is not sure."""

    def __init__(self, level: int = 3, offset: float = 0.0) -> None:
        super().__init__(*SCALE, num_cameras=2, any_cameras=True)
        self.level, self.grid, self.offset = level, Icosphere(level), offset
        self.index = torch.zeros(self.grid.num_vertices)

    def predict(self, images: Any, rig: Any, seen: Any = None) -> DepthEstimate:
        sure = (torch.arange(len(self.index)) % 2).float()[None]
        index = self.index[None] + self.offset * (1 - sure)
        return DepthEstimate(index, sure, torch.ones_like(sure, dtype=torch.bool))


@pytest.fixture(scope="module")
def frame() -> TrackFrame:
    return render_frame(TRACKS["outdoors"], 0, TINY)


def test_errors_of_a_known_offset(frame: TrackFrame) -> None:
    """0.8 hypotheses are 5 % of N; half of the points are off, and the other half is known to be right."""
    truth = FrameTruth(frame)

    def errors(offset: float, max_depth: Limit = "auto") -> dict[str, Any]:
        net = Oracle(offset=offset)
        net.index = truth.index
        answer = Method("oracle", net)(frame)
        return errors_of_frame(PlaceErrors(3, max_depth).errors(answer, truth), 0)

    found = errors(0.8)
    counts = truth.regions["all"]
    off = (torch.arange(len(truth.index)) % 2 == 0)[counts].float().mean().item()
    assert found["fine"]["all"]["MAE"] == pytest.approx(5.0 * off, rel=1e-4)
    assert found["fine"]["all"][">3"] == pytest.approx(100 * off, rel=1e-4)
    assert found["kept"]["0.5"] == pytest.approx(0.0, abs=1e-4)
    assert found["points"]["all"] + found["points"]["lone"] == pytest.approx(
        100 * truth.valid.float().mean().item(), abs=1e-3
    )
    assert found["fine"]["sky"]["MAE"] is not None  # outdoors has one
    assert errors(0.0)["fine"]["all"]["MAE"] == pytest.approx(0, abs=1e-4)
    assert errors(0.0)["metres"] == {"AbsRel": pytest.approx(0, abs=1e-4), "d<1.25": 1.0}
    assert errors(0.0, 0.5)["metres"] == {"AbsRel": None, "d<1.25": None}  # nothing is that near


def test_tilted_tracks_compare_the_same_points() -> None:
    tracks = [track for track in chosen_tracks(["tilts"]) if track.tilt_deg in (0, 45)]
    truths = [FrameTruth(render_frame(track, 0, TINY)) for track in tracks]
    assert torch.equal(truths[0].regions["shared"], truths[1].regions["shared"])
    assert truths[0].regions["all"].sum() > truths[1].regions["all"].sum() > 0
    assert (truths[1].regions["shared"] <= truths[1].regions["all"]).all()


def test_differences_between_cameras_are_compensated_for_all_methods_alike() -> None:
    size = Size(level=3, panorama_rows=8, image_rows=96, samples_per_pixel=1, preparation=AS_IT_IS)
    clean, with_faults, without = (
        render_frame(
            TRACKS[name], 0, replace(size, preparation=replace(AS_IT_IS, photometric=photometric))
        ).images
        for name, photometric in (("clean", True), ("exposure", False), ("exposure", True))
    )
    left, before = (
        sum((images[name].mean() / clean[name].mean()).log().abs().item() for name in clean)
        for images in (without, with_faults)
    )
    assert left < before / 2


def test_a_masked_carrier_is_not_seen_and_disturbances_leave_truth_alone() -> None:
    plain, hidden = (render_frame(TRACKS[name], 0, TINY) for name in ("ugv", "ugv_masked"))
    assert not plain.rig.masks
    assert all(bool((~mask).any()) for mask in hidden.rig.masks.values())
    assert torch.equal(plain.inverse_depth, hidden.inverse_depth)
    seen = [Intake(frame.rig, Icosphere(3)).seen.sum() for frame in (plain, hidden)]
    assert seen[1] < seen[0]
    assert plain.inverse_depth[-1] <= 1 / SCALE.min_depth  # the floor, not the vehicle above it
    counts = [FrameTruth(frame).regions["all"] for frame in (plain, hidden)]
    assert torch.equal(*counts)
    clean, off = (render_frame(TRACKS[name], 0, TINY) for name in ("clean", "pose_1.0"))
    assert torch.equal(clean.inverse_depth, off.inverse_depth)
    assert all(torch.equal(clean.images[name], off.images[name]) for name in clean.images)
    assert not torch.equal(clean.rig.world_from_camera, off.rig.world_from_camera)


def test_seeds_are_held_out() -> None:
    assert {track.seed(0) for track in TRACKS.values()} == {HELD_OUT_SEED}
    rig = TRACKS["room"].make_rig(0, 16)
    with pytest.raises(ArgumentError, match="held out for the benchmark"):
        SceneDataModule(rig=rig, train_seed=HELD_OUT_SEED - 10, num_train=11)
    with pytest.raises(ArgumentError, match="seeds below"):
        TRACKS["room"].seed(-1)


def test_keys_of_a_data_module_are_those_of_its_world() -> None:
    keys: dict[str, Any] = {"samples_per_pixel": 3, "kind": "hall", "num_val": 7, "antialias": False}
    rig = TRACKS["room"].make_rig(0, 16)
    for more, world in (
        ({"carrier": "pole"}, {"carrier": "pole"}),
        ({"tilts_deg": [-10, 90]}, {"tilts": (-math.pi / 18, math.pi / 2)}),
    ):
        data = SceneDataModule(rig=rig, **keys, **more)
        data.view, data.min_depth = SampleView(4, 2, antialias=True), 1.1
        samples = data.plain("val")
        assert samples.world == World(rig, "hall", 1.1, carrier_counts=True, samples_per_pixel=3, **world)
        assert (samples.view, samples.seeds) == (SampleView(4, 2), range(1_000_000, 1_000_007))


def sweep(penalty: float = 0.3) -> Method:
    return Method("sweep", SemiGlobalSweep(3, 4, small_penalty=penalty))


def test_weights_change_the_identity_of_a_method_and_its_records(tmp_path: Path) -> None:
    one, two = sweep(0.3), sweep(0.4)
    assert identity_of(one.net) != identity_of(two.net)
    track = TRACKS["room"]

    def run_track(method: Method, numbers: range) -> Record:
        return running.run_track(TrackFrames(track, numbers, TINY, None), [method], tmp_path)["sweep"]

    first = run_track(one, range(1))
    assert run_track(one, range(1)).frames == first.frames  # its seconds, too
    assert run_track(two, range(1)).frames != first.frames
    run_track(two, range(1, 2))
    both = run_track(two, range(2))
    assert list(both.drawn) == [track.frame_name(n) for n in (0, 1)]
    assert list(run_track(one, range(1, 2)).drawn) == [track.frame_name(1)]
    with pytest.raises(FileNotFoundError, match="nowhere"):
        make_method("nowhere.safetensors")


def test_another_aligner_changes_all_records(monkeypatch: pytest.MonkeyPatch) -> None:
    keys = []
    for penalty in (0.3, 0.4):
        monkeypatch.setattr(track_frames, "aligner", lambda p=penalty: SemiGlobalSweep(3, 4, small_penalty=p))
        for align in (True, False):
            track_frames._aligner_identity.cache_clear()
            size = replace(TINY, preparation=replace(AS_IT_IS, align=align))
            keys.append(TrackFrames(TRACKS["room"], range(1), size, None).key)
    track_frames._aligner_identity.cache_clear()
    assert keys[0] != keys[2]
    assert keys[1] == keys[3]


WORDS = (
    *TINY_BENCHMARK,
    *typed("methods=[constant,semi-global-sweep] tracks=[room,tilt_0,tilt_45] frames=2 output=out"),
)


def result_of(folder: Path, method: str, track: str = "room") -> dict[str, Any]:
    """What the JSON of a comparison has of a method on a track."""
    results = json.loads((folder / "benchmark.json").read_text())["results"]
    (result,) = (r for r in results if (r["frames"], r["method"]) == (track, method))
    return dict(result)


def test_it_is_killed_and_goes_on(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, scene_cache: str
) -> None:
    monkeypatch.setattr(methods, "TRAINING_SCENES", 3)
    words = (*WORDS, f"cache_dir={scene_cache}", "max_depth_m=7")
    asked: list[tuple[str, str]] = []
    answer = Method.__call__

    def counting(self: Method, frame: TrackFrame) -> Any:
        asked.append((self.name, frame.name))
        if len(asked) == 6:
            raise KeyboardInterrupt
        return answer(self, frame)

    monkeypatch.setattr(Method, "__call__", counting)
    with pytest.raises(SystemExit):
        run("benchmark", *words)
    records = [path.read_text() for path in (tmp_path / "out/records").rglob("*.json")]
    assert sum(len(json.loads(text)["frames"]) for text in records) == 5
    run("benchmark", *words)
    assert len(asked) == 3 * 2 * 2 + 1  # the one that was interrupted twice
    first = (tmp_path / "out/benchmark.md").read_text()
    assert first.count("| semi-global-sweep |") >= 3
    assert "| tilt_45 | " in first
    assert first.count(", within 7 m, ") == 2
    assert result_of(tmp_path / "out", "constant")["num_frames"] == 2
    for name in ("room", "tilt_0", "tilt_45"):
        assert read_image(tmp_path / f"out/pages/{name}.png").std() > 0.05
    run("benchmark", *words)
    assert len(asked) == 3 * 2 * 2 + 1
    assert (tmp_path / "out/benchmark.md").read_text() == first


def test_it_takes_other_frames_and_keeps_both(run: Run, tmp_path: Path, scene_cache: str) -> None:
    words = (*WORDS, f"cache_dir={scene_cache}", "tracks=[room]", "frames=1")
    words = (*words, "methods=[semi-global-sweep]")
    results, pages = [], []
    run("benchmark", *words, "frames=2")
    for first in (0, 1, 0):  # of the records that frames=2 leaves only the first is drawn
        run("benchmark", *words, f"first_frame={first}")
        results.append(result_of(tmp_path / "out", "semi-global-sweep"))
        pages.append((tmp_path / "out/pages/room.png").read_bytes())
    kept = json.loads((tmp_path / "out/records/room/semi-global-sweep.json").read_text())["frames"]
    assert list(kept) == [TRACKS["room"].frame_name(number) for number in (0, 1)]
    assert [result["errors"]["fine"] for result in results[:2]] == [score["fine"] for score in kept.values()]
    assert results[0] == results[2] != results[1]
    assert pages[0] == pages[2] != pages[1]


@pytest.fixture(scope="session")
def scene_cache(tmp_path_factory: pytest.TempPathFactory) -> str:
    return str(tmp_path_factory.mktemp("benchmark_scenes"))


@pytest.mark.slow
def test_processes_give_the_same(run: Run, tmp_path: Path, scene_cache: str) -> None:
    """One spawned process measures what this one does."""
    small = (*WORDS, "tracks=[room]", "frames=1", f"cache_dir={scene_cache}")
    run("benchmark", *small)
    run("benchmark", *small, "workers=1", "output=other")
    one, other = (result_of(tmp_path / folder, "semi-global-sweep")["errors"] for folder in ("out", "other"))
    assert one["fine"] == other["fine"]
    assert one["panorama"] == other["panorama"]
    assert not math.isnan(one["fine"]["all"]["MAE"])
