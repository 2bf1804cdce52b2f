# SPDX-License-Identifier: Apache-2.0
"""Write a data set in the layout of the omnidirectional stereo sets, for this package's reader and other people's."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch

from sphericalvision.cameras import (
    Camera,
    CameraRig,
    EquirectangularCamera,
    OCamCamera,
    convert,
    read_rig,
    save_camera,
    save_rig,
)
from sphericalvision.cameras.calibration.poses import axis_angle_from_rotation
from sphericalvision.cameras.field_of_view import visible_angle
from sphericalvision.cameras.rig import check_images_of
from sphericalvision.core import ArgumentError, check_choice
from sphericalvision.data.omnistereo.ground_truth import write_ground_truth
from sphericalvision.data.omnistereo.releases import (
    RELEASES,
    Release,
    check_scale,
    index_frames,
    read_min_depth,
)
from sphericalvision.icosphere import Icosphere
from sphericalvision.io.files import write_bytes
from sphericalvision.io.images import write_image
from sphericalvision.io.yaml_files import read_yaml, write_yaml

_MOST_COEFFICIENTS = 18
_SAME_PIXEL = 0.1  # pixels; fits of one lens made by different machines differ by less


def write_omnistereo(
    root: str | Path,
    frames: Iterable[Mapping[str, Any]],
    rig: CameraRig,
    release: str = "png",
    min_depth: float = 0.55,
) -> list[str]:
    """Write frames and calibration so that ``OmniStereoDataset(root, split="all")`` reads them back.

    Lengths are written unchanged: both releases of your own scene have one scale.
    Images lose half a grey level, the PNG release's inverse depth half of 1 / (65500 * min_depth) 1/m, the
    TIFF release's nothing. Cameras that are no ``OCamCamera`` are written as OCam fits (within 0.1 px); rigs with
    panoramas, which have none, as this package's own YAML, in the TIFF release. Masks are part of the TIFF release
    only. Files of the same name are replaced.

    Args:
        root: folder, made if need be; it must not hold the other release.
        frames: samples as ``OmniStereoDataset`` gives them, consumed one by one: ``images`` (camera name ->
            float ``(3, h, w)`` in [0, 1]), ``inverse_depth`` ``(H, W)`` in 1/m, optionally ``valid``, and
            ``frame``, a number or its digits; a ``rig`` in them has to be the one given.
        rig: its cameras become cam1, cam2, ... in their order.
        release: "png" (ocam*.txt, poses.txt in cm, 16-bit ground truth) or "tiff" (config.yaml, float
            ground truth).
        min_depth: metres, at least the rig's radius; scales the PNG encoding and stands in config.yaml.

    Returns:
        Names of the frames written, five digits each.

    Raises:
        ArgumentError: ``root`` holds the other release or frames of another rig, a frame has other cameras than the
            rig, or a rig of other poses, or is no number, or the release cannot hold the cameras or the rig's centre.
        ShapeError: an image of another size than its camera's.
        FileFormatError: ``min_depth`` and the rig are a mixture of the published scales, which no reader
            may accept.

    Examples:
        >>> from sphericalvision.cameras import CameraRig, EquirectangularCamera, ring_rig
        >>> from sphericalvision.scenes import make_scene, render_rig
        >>> rig = CameraRig([EquirectangularCamera((8, 16))] * 2, ring_rig(2).world_from_camera)
        >>> images = render_rig(make_scene("room"), rig)
        >>> frame = {"frame": 1, "images": images, "inverse_depth": torch.ones(16, 32)}
        >>> write_omnistereo("written", [frame], rig, release="tiff")
        ['00001']
        >>> sorted(path.name for path in Path("written").iterdir())
        ['cam1', 'cam2', 'config.yaml', 'omnidepth_gt_640']
    """
    check_choice("release", release, tuple(RELEASES))
    root, layout = Path(root), RELEASES[release]
    for other in RELEASES.values():
        if other is not layout and (
            (root / other.calibration).exists() or (root / other.ground_truth_folder).exists()
        ):
            raise ArgumentError(
                f"root: {root} holds a {other.name.upper()} release; write into another folder"
            )
    check_scale(root, layout, min_depth, float(rig.radius))
    if not torch.allclose(rig.center, rig.positions.mean(-2), atol=1e-4):
        raise ArgumentError(
            f"rig: its centre is between {', '.join(rig.around or ())}, which files cannot say; expected that of all "
            "cameras, around which inverse_depth of the frames has to be"
        )
    stored = _stored_rig(rig, layout)
    _refuse_other_calibration(root, layout, stored, min_depth)
    has_calibration = (
        layout.name == "png" and (root / layout.calibration).is_file() and bool(_frames_in(root, layout))
    )
    if not has_calibration:  # files of the same rig differ in the last digits of their fits from run to run
        _write_calibration(root, _calibration(root, layout, stored, min_depth))
    written = [_write_frame(root, layout, rig, sample, min_depth) for sample in frames]
    numbers: list[int] = []
    while layout.name == "tiff" and numbers != (now := _frames_in(root, layout)):
        # Now config.yaml knows the last frame; once more if another process has added some meanwhile.
        numbers = now
        _write_calibration(root, _calibration(root, layout, stored, min_depth))
    return [f"{frame:05d}" for frame in written]


def _write_frame(
    root: Path, layout: Release, rig: CameraRig, sample: Mapping[str, Any], min_depth: float
) -> int:
    try:
        frame = int(sample["frame"])
    except ValueError:
        raise ArgumentError(f"frame: expected a number or its digits, got {sample['frame']!r}") from None
    images, own = sample["images"], sample.get("rig", rig)
    check_images_of(rig, images, f"frame {frame}: images")
    poses = own.world_from_camera.to(rig.world_from_camera)
    if own.names != rig.names or not torch.allclose(poses, rig.world_from_camera, atol=1e-4):
        raise ArgumentError(f"frame {frame}: its rig has other cameras or poses than the one given")
    for number, name in enumerate(rig.names, start=1):
        write_image(root / f"cam{number}" / f"{frame:05d}.png", images[name])
    truth = root / layout.ground_truth_folder / f"{frame:05d}{layout.suffix}"
    write_ground_truth(truth, sample["inverse_depth"], min_depth, sample.get("valid"))
    return frame


def _stored_rig(rig: CameraRig, layout: Release) -> CameraRig:
    """The rig as its files can hold it: cameras cam1, cam2, ..., all of them OCam or any."""
    masks = {f"cam{k}": rig.masks[name] for k, name in enumerate(rig.names, start=1) if name in rig.masks}
    poses = rig.world_from_camera.detach().cpu().double()
    if any(isinstance(camera, EquirectangularCamera) for camera in rig.cameras.values()):
        if layout.name == "png":
            raise ArgumentError(
                "release: panoramas have no OCam model, which ocam*.txt would hold; write release='tiff', whose "
                "config.yaml holds any camera"
            )
        return CameraRig(list(rig.cameras.values()), poses, masks)
    fitted = {
        id(camera): camera if isinstance(camera, OCamCamera) else _rounded(ocam_from_camera(camera))
        for camera in rig.cameras.values()
    }
    return CameraRig([fitted[id(camera)] for camera in rig.cameras.values()], poses, masks)


def _rounded(camera: OCamCamera) -> OCamCamera:
    """Eight digits of the polynomial, a millionth of a pixel: further ones differ from process to process."""
    digits = [float(f"{value:.7e}") for value in camera.polynomial.tolist()]
    return camera.with_intrinsics({"polynomial": camera.polynomial.new_tensor(digits)})


def _calibration(root: Path, layout: Release, rig: CameraRig, min_depth: float) -> dict[str, bytes]:
    """Names and contents of the calibration files and masks; config.yaml names the range of the frames in ``root``."""
    with TemporaryDirectory() as folder:
        if layout.name == "png":
            _write_ocam_files(Path(folder), layout, rig)
        else:
            config = Path(folder) / layout.calibration
            ocam = all(isinstance(camera, OCamCamera) for camera in rig.cameras.values())
            save_rig(rig, config, format="omnimvs" if ocam else "native")
            write_yaml(config, {**_description(root, layout, min_depth), **read_yaml(config)})
        return {path.name: path.read_bytes() for path in Path(folder).iterdir()}


def _write_ocam_files(folder: Path, layout: Release, rig: CameraRig) -> None:
    """``ocam1.txt``, ... and the poses in cm: axis-angle in radians and translation, camera to rig."""
    lines = ["# translation_unit: cm\n"]
    for number, (camera, pose) in enumerate(zip(rig.cameras.values(), rig.world_from_camera, strict=True), 1):
        save_camera(camera, folder / f"ocam{number}.txt", format="ocamcalib")
        numbers = [*axis_angle_from_rotation(pose[:3, :3]), *(100 * pose[:3, 3]).tolist()]
        lines.append(" ".join(f"{value:.17g}" for value in numbers) + "\n")
    (folder / layout.calibration).write_text("".join(lines))


def _description(root: Path, layout: Release, min_depth: float) -> dict[str, Any]:
    """What config.yaml holds in addition to the cameras."""
    dataset: dict[str, Any] = {"img_fmt": "cam%d/%05d.png"}
    frames = _frames_in(root, layout)
    if frames:
        dataset.update(start=min(frames), step=1, end=max(frames))
    return {"config": {"omnimvs_sweep_min_depth": float(min_depth)}, "dataset": dataset}


def _write_calibration(root: Path, files: Mapping[str, bytes]) -> None:
    for name, content in files.items():
        write_bytes(root / name, content)


def _refuse_other_calibration(root: Path, layout: Release, rig: CameraRig, min_depth: float) -> None:
    """More frames may be added to a set, but not frames of another rig."""
    path = root / layout.calibration
    if not path.is_file() or not _frames_in(root, layout):
        return
    in_cm = "cm" if layout.name == "png" else None
    existing = read_rig(path, translation_unit=in_cm, dtype=torch.float64)
    its_depth = read_min_depth(path) if layout.name == "tiff" else None
    if not _alike(existing, rig, layout) or its_depth not in (None, float(min_depth)):
        raise ArgumentError(
            f"root: {root} holds frames whose {layout.calibration} differs from the rig or min_depth given; to add "
            "frames use the same, else write into another folder"
        )


def _alike(first: CameraRig, second: CameraRig, layout: Release) -> bool:
    """Whether two rigs have the same names and poses, see the same in the same pixels, and have equal masks."""
    sizes = [[camera.image_size for camera in rig.cameras.values()] for rig in (first, second)]
    if first.names != second.names or sizes[0] != sizes[1]:
        return False
    if not torch.allclose(first.world_from_camera, second.world_from_camera, rtol=0, atol=1e-6):
        return False
    rays = Icosphere(3, torch.float64).vertices
    for name in first.names:
        (pixels, seen), (others, also) = (rig.cameras[name].project(rays) for rig in (first, second))
        if layout.name == "tiff" and bool((seen != also).any()):  # ocam*.txt does not hold the field of view
            return False
        if bool(((pixels - others)[seen & also].abs() > _SAME_PIXEL).any()):
            return False
    if layout.name == "png":  # which holds no masks
        return True
    masks = first.masks, second.masks
    return masks[0].keys() == masks[1].keys() and all(torch.equal(masks[0][n], masks[1][n]) for n in masks[0])


def _frames_in(root: Path, layout: Release) -> list[int]:
    folder = root / layout.ground_truth_folder
    return list(index_frames(folder, "ground truth", (layout.suffix,))) if folder.is_dir() else []


def ocam_from_camera(camera: Camera, max_residual: float = 0.1) -> OCamCamera:
    """OCam camera with direct and inverse polynomial that images like ``camera``, in float64.

    Args:
        camera: unbatched. An ``OCamCamera`` that has its inverse polynomial is returned as it is.
        max_residual: largest deviation accepted, in pixels.

    Raises:
        ArgumentError: no polynomial comes that close over all that the camera sees, or the camera is a batch
            or a panorama.

    References:
        Scaramuzza et al., A Toolbox for Easily Calibrating Omnidirectional Cameras, IROS 2006.

    Examples:
        >>> from sphericalvision.cameras import FisheyeCamera
        >>> fisheye = FisheyeCamera.from_field_of_view((800, 768), math.radians(220))
        >>> ocam = ocam_from_camera(fisheye)
        >>> ray = fisheye.unproject(torch.tensor([100.0, 500.0])).directions
        >>> ocam.project(ray.double()).pixels.round().tolist()
        [100.0, 500.0]
    """
    if isinstance(camera, OCamCamera) and camera.inverse_polynomial is not None:
        return camera
    if isinstance(camera, EquirectangularCamera):
        raise ArgumentError(
            "camera: a panorama has no OCam model, which images growing angles at growing radii; reproject its images "
            "to a lens with remap(...)"
        )
    exact = camera.to(torch.float64)
    fit = convert(exact, to=OCamCamera)
    if fit.max_error > max_residual:
        fit = convert(exact, to=OCamCamera, num_coefficients=_MOST_COEFFICIENTS)
    azimuths = torch.arange(64, dtype=torch.float64) * (math.pi / 32)
    lost = float(visible_angle(exact, azimuths).max()) - fit.covered_angle
    if not fit.max_error <= max_residual or lost > 1e-3:
        raise ArgumentError(
            f"camera: the best OCam model of this {type(camera).__name__} is off by {fit.max_error:.3g} px out to "
            f"{math.degrees(fit.covered_angle):.1f} degrees, more than max_residual = {max_residual:g} px or less "
            "than the camera sees. Use an OCamCamera, or a smaller max_angle."
        )
    assert isinstance(fit.camera, OCamCamera)
    return fit.camera
