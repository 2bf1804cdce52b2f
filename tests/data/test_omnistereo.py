# SPDX-License-Identifier: Apache-2.0
"""What the writer writes has the published layout, and the reader reads it back."""

import math
import re
import shutil
from collections.abc import Callable, Mapping
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
import yaml
from torch.utils.data import DataLoader

from sphericalvision.cameras import CameraRig, read_rig, ring_rig
from sphericalvision.core import ArgumentError, FileFormatError, MissingFileError, ShapeError
from sphericalvision.data import OmniStereoDataset, collate_samples, write_omnistereo
from sphericalvision.data.collate import Sample
from sphericalvision.data.omnistereo import writer
from sphericalvision.scenes.random_rigs import random_rig
from tests.worlds import frames_of_noise

Frames = Callable[..., list[Sample]]


@pytest.mark.parametrize("size", [(16, 32), (8, 32)], ids=["full sphere", "urban"])
@pytest.mark.parametrize("release", ["png", "tiff"])
def test_what_is_written_is_read(
    tmp_path: Path, rig: CameraRig, frames: Frames, release: str, size: tuple[int, int]
) -> None:
    written = frames(1, 2, 7, height=size[0], width=size[1])
    assert write_omnistereo(tmp_path, written, rig, release) == ["00001", "00002", "00007"]
    data = OmniStereoDataset(tmp_path, split="all")
    assert data.frames == [1, 2, 7]
    assert data.release.name == release
    assert data.min_depth == 0.55
    step = 0.5 / (65500 * 0.55) + 2e-7 if release == "png" else 0.0
    for expected, sample in zip(written, data, strict=True):
        assert sample["frame"] == expected["frame"]
        assert list(sample["images"]) == list(rig.names)
        for name, image in sample["images"].items():
            torch.testing.assert_close(image, expected["images"][name], rtol=0, atol=0.5 / 255 + 1e-6)
        torch.testing.assert_close(sample["inverse_depth"], expected["inverse_depth"], rtol=0, atol=step)
        assert sample["valid"].all()


@pytest.mark.parametrize("release", ["png", "tiff"])
def test_the_rig_is_read_back(tmp_path: Path, release: str, generator: torch.Generator) -> None:
    rig = random_rig(generator, (3,), image_size=(50, 44), panoramas=0.0)
    write_omnistereo(tmp_path, frames_of_noise(rig, [1]), rig, release)
    again = OmniStereoDataset(tmp_path, split="all").rig
    torch.testing.assert_close(
        again.world_from_camera.double(), rig.world_from_camera.double(), rtol=0, atol=1e-6
    )
    points = torch.randn(1000, 3, generator=generator)
    for name in rig.names:
        expected, result = rig.cameras[name].project(points), again.cameras[name].project(points)
        both = expected.valid & result.valid
        if release == "tiff":  # ocam*.txt does not tell the field of view
            assert (expected.valid != result.valid).float().mean() < 0.01
        torch.testing.assert_close(result.pixels[both], expected.pixels[both], rtol=0, atol=5e-3)


def test_frames_that_another_process_adds_meanwhile_are_in_the_range(
    tmp_path: Path, rig: CameraRig, frames: Frames, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It may end while config.yaml is being written for the last time."""
    write, calls = writer._write_calibration, 0

    def write_beside_another(root: Path, files: Mapping[str, bytes]) -> None:
        nonlocal calls
        write(root, files)
        calls += 1
        if calls == 2:
            truth = next(path for path in root.rglob("00002.*") if "cam" not in path.parent.name)
            shutil.copy(truth, truth.with_stem("00009"))

    monkeypatch.setattr(writer, "_write_calibration", write_beside_another)
    write_omnistereo(tmp_path, frames(1, 2), rig, "tiff")
    assert yaml.safe_load((tmp_path / "config.yaml").read_text())["dataset"]["end"] == 9


def test_convention_layout_of_the_png_release(tmp_path: Path, rig: CameraRig, frames: Frames) -> None:
    write_omnistereo(tmp_path, frames(12), rig, "png")
    names = sorted(str(file.relative_to(tmp_path)) for file in tmp_path.rglob("*") if file.is_file())
    assert names == [
        *(f"cam{k}/00012.png" for k in range(1, 5)),
        "depth_train_640/00012.png",
        *(f"ocam{k}.txt" for k in range(1, 5)),
        "poses.txt",
    ]
    poses = np.loadtxt(tmp_path / "poses.txt")  # cm; front, right, back, left
    torch.testing.assert_close(read_rig(tmp_path).positions, rig.positions, rtol=0, atol=1e-6)
    np.testing.assert_allclose(poses[:, 3:], [[0, 0, 20], [20, 0, 0], [0, 0, -20], [-20, 0, 0]], atol=1e-5)
    np.testing.assert_allclose(poses[:2, :3], [[0, 0, 0], [0, math.pi / 2, 0]], atol=1e-6)
    assert cv2.imread(str(tmp_path / "depth_train_640/00012.png"), cv2.IMREAD_UNCHANGED).dtype == np.uint16


def test_convention_layout_of_the_tiff_release(tmp_path: Path, rig: CameraRig, frames: Frames) -> None:
    write_omnistereo(tmp_path, frames(3, 4), rig, "tiff")
    config = yaml.safe_load((tmp_path / "config.yaml").read_text())
    assert config["config"] == {"omnimvs_sweep_min_depth": 0.55}
    assert config["dataset"] == {"img_fmt": "cam%d/%05d.png", "start": 3, "step": 1, "end": 4}
    first = config["cameras"][0]
    assert first["image_size"] == [50, 48]
    assert first["center"] == pytest.approx([24.5, 23.5])  # row, column
    assert first["max_fov"] == pytest.approx(220, abs=1e-4)
    assert first["poly"][0] == len(first["poly"]) - 1
    assert first["inv_poly"][0] == len(first["inv_poly"]) - 1
    assert config["cameras"][1]["pose"] == pytest.approx([0, math.pi / 2, 0, 0.2, 0, 0], abs=1e-6)  # metres
    _, (thumbnail, numbers) = cv2.imreadmulti(
        str(tmp_path / "omnidepth_gt_640/00003.tiff"), flags=cv2.IMREAD_UNCHANGED
    )
    assert (thumbnail.dtype, thumbnail.shape) == (np.uint8, (16, 32, 3))
    assert (numbers.dtype, numbers.shape) == (np.float32, (16, 32))
    grey = (255 * 0.55 * frames(3)[0]["inverse_depth"]).round()[..., None]  # white at the least depth
    assert np.array_equal(thumbnail, grey.expand(-1, -1, 3).numpy())


def test_four_digits_in_the_other_folders_are_found(tmp_path: Path, rig: CameraRig, frames: Frames) -> None:
    """The fault of OmniThings; and OmniHouse has four digits everywhere."""
    write_omnistereo(tmp_path, frames(1, 2), rig)
    before = OmniStereoDataset(tmp_path, frames=[2])[0]
    for folder in ("cam2", "cam3", "cam4"):
        for file in list((tmp_path / folder).iterdir()):
            file.rename(file.with_name(file.name[1:]))
    after = OmniStereoDataset(tmp_path, frames=[2])[0]
    assert all(torch.equal(before["images"][name], after["images"][name]) for name in rig.names)
    for folder in ("cam1", "depth_train_640"):
        for file in list((tmp_path / folder).iterdir()):
            file.rename(file.with_name(file.name[1:]))
    assert len(OmniStereoDataset(tmp_path, split="all")) == 2


def test_splits_and_partial_copies(tmp_path: Path, rig: CameraRig, frames: Frames) -> None:
    write_omnistereo(tmp_path, frames(4096, 4097, 8241), rig)
    assert OmniStereoDataset(tmp_path, split="train", missing="skip").frames == [4096]
    assert OmniStereoDataset(tmp_path, split="val", missing="skip").frames == [8241]
    assert OmniStereoDataset(tmp_path, split="test", protocol="official", missing="skip").frames == [4097]
    (tmp_path / "cam3" / "04097.png").unlink()
    with pytest.raises(
        MissingFileError, match=r"1 of the 2 frames.*cam3/ lacks 1 \(first 04097\).*missing='skip'"
    ):
        OmniStereoDataset(tmp_path, frames=[4096, 4097])
    with pytest.raises(MissingFileError, match=r"7215 of the 7216 frames"):
        OmniStereoDataset(tmp_path)


def test_an_empty_set_is_refused(tmp_path: Path, rig: CameraRig) -> None:
    write_omnistereo(tmp_path, [], rig)
    with pytest.raises(MissingFileError, match="depth_train_640"):
        OmniStereoDataset(tmp_path, split="all")


def test_a_rig_in_the_wrong_unit_or_scale_is_refused(tmp_path: Path, rig: CameraRig, frames: Frames) -> None:
    write_omnistereo(tmp_path, frames(1), rig)
    poses = np.loadtxt(tmp_path / "poses.txt")
    poses[:, 3:] *= 3  # the other release's
    np.savetxt(tmp_path / "poses.txt", poses)
    with pytest.raises(FileFormatError, match=r"minimum depth 0\.55 m, rig radius 0\.6 m"):
        OmniStereoDataset(tmp_path, split="all")
    assert OmniStereoDataset(tmp_path, split="all", min_depth=1.65).min_depth == 1.65
    with (
        pytest.warns(UserWarning, match="check the unit"),
        pytest.raises(FileFormatError, match=r"rig radius 60 m.*unit of the poses"),
    ):
        OmniStereoDataset(tmp_path, split="all", translation_unit="m")


def test_the_other_scale_in_config_yaml_is_refused(tmp_path: Path, rig: CameraRig, frames: Frames) -> None:
    write_omnistereo(tmp_path, frames(1), rig, "tiff")
    config = tmp_path / "config.yaml"
    config.write_text(re.sub(r"(min_depth: )[0-9.]+", r"\g<1>1.65", config.read_text()))
    with pytest.raises(FileFormatError, match=r"minimum depth 1\.65 m, rig radius 0\.2 m"):
        OmniStereoDataset(tmp_path, split="all")


def test_writing_into_the_other_release_or_a_mixture_is_refused(
    tmp_path: Path, rig: CameraRig, frames: Frames
) -> None:
    write_omnistereo(tmp_path, frames(1), rig, "png")
    with pytest.raises(ArgumentError, match="holds a PNG release"):
        write_omnistereo(tmp_path, frames(1), rig, "tiff")
    with pytest.raises(FileFormatError, match="scales do not belong together"):
        write_omnistereo(tmp_path / "new", frames(1), ring_rig(4, 0.6, (50, 48)), "png")


def test_frames_that_do_not_fit_the_rig_are_refused(tmp_path: Path, rig: CameraRig, frames: Frames) -> None:
    sample = frames(1)[0]
    del sample["images"]["cam3"]
    with pytest.raises(ArgumentError, match=r"frame 1: images: .*cam3"):
        write_omnistereo(tmp_path, [sample], rig)
    sample = frames(1)[0]
    sample["images"]["cam3"] = sample["images"]["cam3"][:, 1:]
    with pytest.raises(ShapeError, match=r"frame 1: images\['cam3'\]: .* 50 x 48"):
        write_omnistereo(tmp_path, [sample], rig)
    with pytest.raises(ArgumentError, match="frame: expected a number"):
        write_omnistereo(tmp_path, [{**frames(1)[0], "frame": "first"}], rig)
    with pytest.raises(ArgumentError, match="frame 1: its rig has other cameras or poses"):
        write_omnistereo(tmp_path, [{**frames(1)[0], "rig": rig.rotated(tilt=0.3)}], rig)
    off_centre = CameraRig(rig.cameras, rig.world_from_camera, around=["cam1"])
    with pytest.raises(ArgumentError, match="rig: its centre is between cam1, which files cannot say"):
        write_omnistereo(tmp_path, frames(1), off_centre)


def test_an_image_of_the_wrong_size_names_the_file(tmp_path: Path, rig: CameraRig, frames: Frames) -> None:
    write_omnistereo(tmp_path, frames(1), rig)
    cv2.imwrite(str(tmp_path / "cam2" / "00001.png"), np.zeros((10, 20, 3), np.uint8))
    with pytest.raises(FileFormatError, match=r"cam2/00001\.png: expected 48 x 50 pixels .* got 20 x 10"):
        OmniStereoDataset(tmp_path, split="all")[0]


def test_a_loader_with_workers_gives_the_same_batches(tmp_path: Path, rig: CameraRig, frames: Frames) -> None:
    write_omnistereo(tmp_path, frames(1, 2, 3), rig, "tiff")
    data = OmniStereoDataset(tmp_path, split="all")
    alone = [collate_samples([data[0], data[1]]), collate_samples([data[2]])]
    loader = DataLoader(data, batch_size=2, num_workers=1, collate_fn=collate_samples)
    for expected, batch in zip(alone, loader, strict=True):
        assert batch["frame"] == expected["frame"]
        assert torch.equal(batch["inverse_depth"], expected["inverse_depth"])
        assert torch.equal(batch["images"]["cam2"], expected["images"]["cam2"])
        assert torch.equal(batch["rig"].world_from_camera, expected["rig"].world_from_camera)


def test_masks_travel_with_the_tiff_release(tmp_path: Path, rig: CameraRig, frames: Frames) -> None:
    mask = torch.ones(50, 48, dtype=torch.bool)
    mask[30:, 10:40] = False
    masked = CameraRig(rig.cameras, rig.world_from_camera, {"cam2": mask})
    write_omnistereo(tmp_path, frames(1), masked, "tiff")
    stored = cv2.imread(str(tmp_path / "mask2.png"), cv2.IMREAD_UNCHANGED)
    assert ((stored == 0) == mask.numpy()).all()  # these sets mark what is not to be used
    assert not (tmp_path / "mask1.png").exists()
    again = OmniStereoDataset(tmp_path, split="all").rig.masks
    assert list(again) == ["cam2"]
    assert torch.equal(again["cam2"], mask)


@pytest.mark.parametrize("release", ["png", "tiff"])
def test_frames_are_added_to_a_set_of_the_same_rig_only(
    tmp_path: Path, rig: CameraRig, frames: Frames, release: str
) -> None:
    write_omnistereo(tmp_path, frames(5), rig, release)
    write_omnistereo(tmp_path, frames(2, 3), rig, release)
    assert OmniStereoDataset(tmp_path, split="all").frames == [2, 3, 5]
    if release == "tiff":
        dataset = yaml.safe_load((tmp_path / "config.yaml").read_text())["dataset"]
        assert (dataset["start"], dataset["end"]) == (2, 5)
    other = ring_rig(4, 0.21, (50, 48))
    with pytest.raises(ArgumentError, match=r"differs from the rig or min_depth given.*another folder"):
        write_omnistereo(tmp_path, frames_of_noise(other, [6]), other, release)
    assert OmniStereoDataset(tmp_path, split="all").rig.radius.item() == pytest.approx(0.2)
