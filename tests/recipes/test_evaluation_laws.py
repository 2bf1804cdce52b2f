# SPDX-License-Identifier: Apache-2.0
"""Measures, methods and tables of comparisons against the same numbers by another way."""

from __future__ import annotations

import csv
import io
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from sphericalvision.cameras import CameraRig, EquirectangularCamera, ring_rig
from sphericalvision.capture.preparation.preparation import AS_IT_IS
from sphericalvision.core import ShapeError
from sphericalvision.data.scanned.helvipad import HELVIPAD_LATITUDES
from sphericalvision.icosphere import Icosphere
from sphericalvision.models import ConstantDepth
from sphericalvision.recipes.evaluation import methods
from sphericalvision.recipes.evaluation.loop import (
    Limit,
    VertexErrors,
    errors_of_frame,
    mean_errors_by_method,
)
from sphericalvision.recipes.evaluation.methods import SCALE, Answer, Method, make_method
from sphericalvision.recipes.evaluation.pictures import camera_picture
from sphericalvision.recipes.evaluation.records import Record
from sphericalvision.recipes.evaluation.rectified_sgbm import RectifiedSGBM
from sphericalvision.recipes.evaluation.results import Results
from sphericalvision.recipes.evaluation.strips import StripErrors, table_with_published
from sphericalvision.recipes.evaluation.tables import Cell, Table, error_table
from sphericalvision.recipes.evaluation.track_frames import Size, render_frame
from sphericalvision.recipes.evaluation.tracks import TRACKS, Track
from sphericalvision.scenes import make_scene, ray_depth, render_rig
from sphericalvision.sphere import Equirectangular
from sphericalvision.sweep import DepthEstimate, index_from_inverse_depth

LEVEL, STRIP = 4, (6, 16)


def distance_to_wall(
    origin: torch.Tensor, rays: torch.Tensor, center: torch.Tensor, radius: float
) -> torch.Tensor:
    """From a place within a hollow ball to its wall, along rays ``(V, 3)``."""
    along = rays @ (center - origin)
    return along + (radius**2 - (center - origin).square().sum() + along.square()).sqrt()


def test_errors_along_the_rays_of_a_camera_that_stands_off_the_centre() -> None:
    """Two frames of hollow balls; a tenth more is true than is estimated, and rows lack either map."""
    bottom, top = torch.tensor([0.1, 0.25, -0.05]), torch.tensor([0.3, -0.15, 0.15])
    poses = torch.eye(4).repeat(2, 2, 1, 1)
    poses[:, 0, :3, 3], poses[:, 1, :3, 3] = bottom, top
    poses[1, :, :3, 3] += torch.tensor([5.0, 0.0, 0.0])  # errors do not depend on where the rig is
    rig = CameraRig([EquirectangularCamera((16, 32))] * 2, poses)
    walls = [(torch.tensor([0.5, 0.1, 0.4]), 3.0), (torch.tensor([-0.3, 0.4, 0.2]), 4.0)]
    net, center = ConstantDepth(LEVEL + 2, *SCALE), (bottom + top) / 2
    around = torch.stack([distance_to_wall(torch.zeros(3), net.grid.directions, *wall) for wall in walls])
    index = index_from_inverse_depth(around.reciprocal(), *SCALE)
    answer = Answer(
        net, DepthEstimate(index, torch.ones_like(index), torch.ones_like(index, dtype=torch.bool))
    )
    rays = Equirectangular(*STRIP, latitudes=HELVIPAD_LATITUDES).directions
    exact = torch.stack([distance_to_wall(bottom - center, rays.flatten(0, 1), *wall) for wall in walls])
    exact = exact.unflatten(-1, STRIP)
    depth, augmented = 1.1 * exact, 1.1 * exact
    depth[:, 0], augmented[:, 0, 3:9], augmented[:, 5] = 0, 0, 0
    measure = StripErrors(SCALE, LEVEL)
    vertices = Icosphere(LEVEL).vertices
    assert torch.equal(measure.directions, vertices)
    batch: dict[str, Any] = {
        "rig": rig, "strip_depth": depth, "strip_depth_augmented": augmented,
        "inverse_depth": around.reciprocal() / 2, "valid": torch.ones(around.shape, dtype=torch.bool),
        "frame": ["a", "b"],
    }  # fmt: skip
    errors = measure.errors(answer, measure.truth(batch))
    across, down = (0.191 * part for part in (rays[1:, :, ::2].norm(dim=-1), rays[1:, :, 1]))

    def degrees(metres: torch.Tensor) -> torch.Tensor:
        return torch.atan2(across, metres + down).rad2deg()

    for frame in range(2):
        numbers = errors_of_frame(errors, frame)
        true, near = depth[frame, 1:], exact[frame, 1:]
        assert numbers["points"]["kept"] == 100
        assert numbers["errors"]["MAE"] == pytest.approx(
            float(100 / 16 * (index[frame] / 2).mean()), rel=1e-3
        )
        assert numbers["depth"]["MARE"] == pytest.approx(0.1 / 1.1, rel=0.02)
        assert numbers["depth"]["MAE"] == pytest.approx(float((true - near).mean()), rel=0.02)
        assert numbers["depth"]["RMSE"] == pytest.approx(
            float((true - near).square().mean().sqrt()), rel=0.02
        )
        apart = degrees(true) - degrees(near)
        assert numbers["disparity"]["MAE"] == pytest.approx(float(apart.abs().mean()), rel=0.02)
        assert numbers["disparity"]["MARE"] == pytest.approx(
            float((apart / degrees(true)).abs().mean()), rel=0.02
        )
        ends = 0.1 * (exact[frame, :5, 0] - exact[frame, :5, -1])
        assert numbers["depth"]["LRCE"] == pytest.approx(float(ends.abs().mean()), rel=0.05)


def test_relative_errors_count_up_to_ten_metres_in_rooms_and_eighty_elsewhere() -> None:
    """Of four points one is 100 m away and estimated at 110, one 20 m and 90, and two are 5 m, one estimated at 6.5."""
    net = ConstantDepth(LEVEL + 2, *SCALE)
    names = ["room-00000000", "outdoors-00000000", "00001"]
    repeats = math.ceil(net.grid.num_vertices / 4)
    true, estimated = (
        torch.tensor(depths).repeat(repeats)[: net.grid.num_vertices].expand(3, -1)
        for depths in ([100.0, 20.0, 5.0, 5.0], [110.0, 90.0, 6.5, 5.0])
    )
    counts = torch.arange(net.grid.num_vertices) < 4 * (repeats - 1)  # whole fours
    index = index_from_inverse_depth(estimated.reciprocal(), *SCALE)
    answer = Answer(
        net, DepthEstimate(index, torch.ones_like(index), torch.ones_like(index, dtype=torch.bool))
    )
    batch = {"inverse_depth": true.reciprocal(), "valid": counts.expand(3, -1), "frame": names}

    def errors(max_depth: Limit) -> list[dict[str, float | None]]:
        measure = VertexErrors(SCALE, LEVEL, max_depth=max_depth)
        every = measure.errors(answer, measure.truth(batch))
        return [errors_of_frame(every, frame)["metres"] for frame in range(3)]

    room = {"AbsRel": pytest.approx(0.3 / 2), "d<1.25": 0.5}
    # 90 m count as 80
    far = {"AbsRel": pytest.approx((3.0 + 0.3) / 3, rel=1e-5), "d<1.25": pytest.approx(1 / 3)}
    assert errors("auto") == [room, far, far]
    farther = {"AbsRel": pytest.approx((0.1 + 3.5 + 0.3) / 4, rel=1e-5), "d<1.25": 0.5}
    assert errors(200.0) == [farther] * 3
    assert errors(4.0) == [{"AbsRel": None, "d<1.25": None}] * 3  # nothing is that near
    record = Record()
    record.add("a", {"errors": {"MAE": 1.5}, "metres": {"AbsRel": 0.0625}, "points": {"kept": 100.0}})
    table = error_table("", mean_errors_by_method({"net": record}))
    assert table.texts() == [["net", "1.50", "0.062"]]
    assert table.csv() == "name,MAE,AbsRel\nnet,1.5,0.0625\n"


def test_records_of_other_settings_are_not_taken_and_what_is_drawn_needs_its_picture(tmp_path: Path) -> None:
    path = tmp_path / "net.json"
    record = Record(path, {"level": 5})
    record.add("7", {"MAE": 1.5})
    record.add("8", {"MAE": 2.5}, torch.tensor([0.25, 3.0]))
    record.save()
    same, other = Record(path, {"level": 5}), Record(path, {"level": 6})
    assert [same.has(name, drawn) for name in "789" for drawn in (False, True)] == [1, 0, 1, 1, 0, 0]
    assert (same.frames, same.drawn["8"].tolist()) == (record.frames, [0.25, 3.0])
    assert (other.frames, other.drawn) == ({}, {})


def test_what_was_published_stands_below_what_was_measured() -> None:
    record = Record()
    errors = {"depth": {"MAE": 1.5, "RMSE": 2.5, "MARE": 0.125, "LRCE": 0.75}}
    record.add("a", {**errors, "disparity": {"MAE": 0.25, "RMSE": 0.5, "MARE": None}})
    table = table_with_published({"net": record}, {"theirs": (1.0, 2.0, 3.0, 4.0)})
    assert table.markdown() == (
        "| | MAE (m) | RMSE (m) | MARE (1) | LRCE (m) | MAE (°) | RMSE (°) | MARE (°/°) |\n"
        "|---|---:|---:|---:|---:|---:|---:|---:|\n"
        "| net | 1.500 | 2.500 | 0.125 | 0.750 | 0.250 | 0.500 | – |\n"
        "| theirs * | 1.000 | 2.000 | 3.000 | 4.000 | – | – | – |\n\n"
        "of depth, and of disparity (°); * published, of the whole test set and older maps of depth\n"
    )


TABLE = Table(
    "50 % of\\N",
    ("", "a_b", "c", "d"),
    [
        ["x & y~^", Cell(1.25, 0.5), 2.0, "t"],
        ["<z> # {$}", None, 1e-7, None],
        ["°", Cell(3, None, 0, (2, 4), True), 0.50004, "–"],
    ],
)


def test_a_table_in_all_formats(tmp_path: Path) -> None:
    """The same cells; what is special to a format stands as the format has it."""
    assert TABLE.markdown() == (
        "| | a_b | c | d |\n|---|---:|---:|---:|\n| x & y~^ | 1.25 ± 0.50 | 2.00 | t |\n| <z> # {$} | – | 0.00 | – |\n"
        "| ° | **3** (2–4) | 0.50 | – |\n\n50 % of\\N\n"
    )
    assert list(csv.reader(io.StringIO(TABLE.csv()))) == [
        ["name", "a_b", "a_b sd", "c", "d"], ["x & y~^", "1.25", "0.5", "2", "t"], ["<z> # {$}", "", "", "1e-07", ""],
        ["°", "3", "", "0.50004", "–"],
    ]  # fmt: skip
    assert TABLE.latex().splitlines() == [
        "% 50 % of\\N", r"\begin{tabular}{lrrr}", r"\toprule", r" & a\_b & c & d \\", r"\midrule",
        r"x \& y\textasciitilde{}\textasciicircum{} & 1.25 $\pm$ 0.50 & 2.00 & t \\",
        r"$<$z$>$ \# \{\$\} & -- & 0.00 & -- \\",
        r"$^\circ$ & \textbf{3} (2--4) & 0.50 & -- \\", r"\bottomrule", r"\end{tabular}",
    ]  # fmt: skip
    assert (
        r"\textbackslash{}" in TABLE._replace(columns=("\\", "a", "b", "c"), title="").latex().splitlines()[2]
    )
    assert TABLE._replace(labels=2).markdown().splitlines()[1] == "|---|---|---:|---:|"
    assert TABLE._replace(labels=2).latex().splitlines()[1] == r"\begin{tabular}{llrr}"
    assert TABLE.html().splitlines() == [
        "<p>50 % of\\N</p>", "<table><tr><th></th><th>a_b</th><th>c</th><th>d</th></tr>",
        "<tr><td>x &amp; y~^</td><td>1.25 ± 0.50</td><td>2.00</td><td>t</td></tr>",
        "<tr><td>&lt;z&gt; # {$}</td><td>–</td><td>0.00</td><td>–</td></tr>",
        "<tr><td>°</td><td><b>3</b> (2–4)</td><td>0.50</td><td>–</td></tr></table>",
    ]  # fmt: skip
    TABLE.save(tmp_path / "a.b", ".md", ".csv", ".tex")
    written = {path.name: path.read_text(encoding="utf-8") for path in tmp_path.iterdir()}
    assert written == {"a.b.md": TABLE.markdown(), "a.b.csv": TABLE.csv(), "a.b.tex": TABLE.latex()}
    assert error_table("", {"a": {"x": 1.0, "y": 2.0}, "b": {"y": 3.0, "x": 4.0}}).texts() == [
        ["a", "1.00", "2.00"], ["b", "4.00", "3.00"],
    ]  # fmt: skip


def results(errors: dict[str, dict[str, list[float]]]) -> Results:
    """Set of frames -> method -> the number of each frame; methods called alike but for a digit are one model."""
    records: dict[str, dict[str, Record]] = {}
    for frames, by_method in errors.items():
        for name, values in by_method.items():
            record = records.setdefault(frames, {}).setdefault(name, Record())
            for frame, value in enumerate(values):
                record.add(str(frame), {"metres": {"AbsRel": value, "d<1.25": value}})
    net = ConstantDepth(2, *SCALE)
    names = next(iter(errors.values()))
    return Results([Method(name, net, label=name.rstrip("0123456789")) for name in names], records)


def test_ratios_are_those_of_the_same_seed_to_the_first_set() -> None:
    """3 / 1 and 10 / 2 are 4 in the mean, √2 apart; the ratio of the means would be 13 / 3."""
    table = results({
        "level": {"net0": [0.5, 1.5], "net1": [2.0, 2.0], "sweep": [4.0, 4.0]},
        "tilted": {"net0": [3.0, 3.0], "net1": [8.0, 12.0], "sweep": [1.0, 1.0]},
    }).against("", "metres AbsRel", {"0": "level", "45": "tilted"})  # fmt: skip
    assert table.columns == ("model", "0", "45", "45 / 0")
    assert table.texts() == [
        ["net", "1.50 ± 0.71", "6.50 ± 4.95", "4.000 ± 1.414"],
        ["sweep", "4.00", "1.00", "0.250"],
    ]


def test_a_row_of_a_set_and_a_model_has_the_mean_and_deviation_of_its_seeds() -> None:
    measured = results({"level": {"net0": [0.5, 1.5], "net1": [2.0, 2.0], "sweep": []}})
    table = measured.by_set("", "θ", {"0°": "level"}, [("AbsRel", "metres AbsRel", 3)])
    assert table.columns == ("θ", "model", "AbsRel")
    assert table.texts() == [["0°", "net", "1.500 ± 0.707"], ["0°", "sweep", "–"]]


@pytest.mark.parametrize(("error", "best"), [("AbsRel", 0), ("d<1.25", 1)])
def test_the_best_of_a_row_is_the_least_error_or_the_largest_fraction(error: str, best: int) -> None:
    table = results({"room": {"a": [0.25, 0.25], "b": [0.5, 0.5], "c": []}}).by_method(
        "", "track", f"metres {error}", 2
    )
    texts = ["0.25 (0.25–0.25)", "0.50 (0.50–0.50)"]
    texts[best] = texts[best].replace(" ", "** ", 1).join(("**", ""))
    assert table.texts() == [["room", *texts, "–"]]
    same = Table.of(json.loads(json.dumps(table._asdict())))
    assert same.texts() == table.texts()


def test_rigs_of_tracks_are_what_their_tracks_say() -> None:
    """Cameras, distances from the centre, sizes and tilts, written out; random rigs are those of their seeds."""
    for track in TRACKS.values():
        rig = track.make_rig(track.seed(1), 64)
        assert track.seed(1) == 10_000_001
        if track.rig == "random":
            assert rig.names == track.make_rig(track.seed(1), 64).names
            assert not torch.equal(rig.positions[:2], track.make_rig(track.seed(2), 64).positions[:2])
            continue
        size = (56, 112) if track.rig == "panoramas" else (64, 64)
        assert {camera.image_size for camera in rig.cameras.values()} == {size}
        if track.rig == "corners":
            continue
        assert len(rig) == track.num_cameras
        torch.testing.assert_close(
            (rig.positions - rig.center).norm(dim=-1), torch.full((len(rig),), track.radius)
        )
        down = torch.full((len(rig),), math.sin(math.radians(track.tilt_deg)))
        torch.testing.assert_close(rig.axes[:, 1], down, atol=1e-6, rtol=0)
        further = Track("a", "a", tilt_deg=3.0).make_rig(1, 64, tilt_deg=10.0).axes[:, 1]
        torch.testing.assert_close(further, torch.full((4,), math.sin(math.radians(10))), atol=1e-6, rtol=0)


def test_words_are_the_methods_that_they_name(monkeypatch: pytest.MonkeyPatch) -> None:
    """A network without training has the scale and the level; the constant is known before it is made."""
    for word in ("winner-takes-all", "semi-global-sweep", "rectified-sgbm", "constant"):
        monkeypatch.setattr(methods, "TRAINING_SCENES", 3)
        scale = SCALE._replace(num_hypotheses=8)
        method = make_method(word, 3, scale)
        assert (method.name, method.label, method.seed) == (word, word, None)
        assert method.identity == make_method(word, 3, scale).identity != make_method(word, 4, scale).identity
        net = method.net
        assert (net.num_hypotheses, net.min_depth, net.training) == (8, SCALE.min_depth, False)


@pytest.mark.parametrize(
    ("shape", "width"), [((40, 80), 20), ((40, 40), 10), ((40, 20), 5), ((40, 200), 20)], ids=str
)
def test_pictures_of_cameras_are_as_wide_as_they_were_and_no_wider_than_a_panorama(
    shape: tuple[int, int], width: int
) -> None:
    assert camera_picture(torch.rand(3, *shape), 10).shape == (10, width, 3)


def test_renderings_are_kept_and_read(tmp_path: Path) -> None:
    """By frame and carrier; what is kept is what is seen the next time."""
    size = Size(level=3, panorama_rows=8, image_rows=16, preparation=AS_IT_IS)
    frames = [render_frame(TRACKS[name], 0, size, tmp_path) for name in ("room", "carrier")]
    kept = sorted(tmp_path.rglob("*.npz"))
    assert len(kept) == 2
    assert sum("robot" in path.name for path in kept) == 1
    assert not torch.equal(frames[0].images["cam1"], frames[1].images["cam1"])
    for path in kept:
        with np.load(path) as stored:
            np.savez(path, **{name: stored[name] // 2 for name in stored.files})
    for name, frame in zip(("room", "carrier"), frames, strict=True):
        again = render_frame(TRACKS[name], 0, size, tmp_path)
        for camera, image in frame.images.items():
            torch.testing.assert_close(again.images[camera], (255 * image).round().div(2).floor() / 255)


def test_depth_of_a_rendered_room() -> None:
    rig, scene = ring_rig(4, image_size=(128, 128)), make_scene("room", seed=3)
    method = make_method("rectified-sgbm", level=5)
    net = method.net
    assert isinstance(net, RectifiedSGBM)
    images = net.intake(rig)(render_rig(scene, rig, samples_per_pixel=2))
    blank = torch.zeros_like(images)
    estimate = net.predict(torch.stack((images, blank)), net.tables(rig))
    assert estimate.index.shape == (2, 48, 96)
    truth = ray_depth(scene, rig.center, net.grid.directions).reciprocal()
    error = (estimate.index[0] - index_from_inverse_depth(truth, 16, 0.55)).abs()
    assert error.median() < 0.3  # of 15
    assert error[estimate.seen[0]].mean() < 1.5
    assert estimate.seen[0].float().mean() > 0.9
    assert (estimate.confidence[~estimate.seen] == 0).all()
    assert estimate.index.isfinite().all()
    assert (estimate.index >= 0).all()
    assert (estimate.index <= 15).all()


def test_what_is_masked_is_not_matched() -> None:
    rig, scene = ring_rig(4, image_size=(64, 64)), make_scene("room", seed=3)
    net = RectifiedSGBM(level=4)
    images = net.intake(rig)(render_rig(scene, rig, samples_per_pixel=1))
    seen = torch.ones(4, 64, 64, dtype=torch.bool)
    seen[0] = False  # of the camera in front
    partly = net.predict(images[None], rig, seen).seen[0]
    # Between ahead and right none but these two cameras look, between back and right two others do.
    aside, behind = partly[8:16, 29:31], partly[8:16, 41:43]
    assert behind.float().mean() > 0.9
    assert not net.predict(images[None], rig, torch.zeros_like(seen)).seen.any()
    assert aside.float().mean() < 0.2
    with pytest.raises(ShapeError, match="images: expected shape"):
        net.predict(images, rig)
