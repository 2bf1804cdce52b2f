# SPDX-License-Identifier: Apache-2.0
"""Files that depth becomes: pictures, point clouds and arrays of each frame, a video and a table of all."""

from __future__ import annotations

import csv
import errno
import io
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, suppress
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import cv2
import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from sphericalvision.capture import Depth, DepthImage
from sphericalvision.capture.checks import OF_A_FRAME, PhotoConsistency
from sphericalvision.capture.folder_record import FolderRecord
from sphericalvision.capture.points import SurfacePoints
from sphericalvision.capture.result import near_end_of
from sphericalvision.core import FileFormatError, check_choice
from sphericalvision.io.files import atomic_write, write_bytes
from sphericalvision.io.images import as_bytes, write_image
from sphericalvision.viz.color import colorize
from sphericalvision.viz.figure import add_scale_bar
from sphericalvision.viz.panorama import confidence_strength, depth_panorama, rgb_panorama
from sphericalvision.viz.pointcloud import save_point_cloud

if TYPE_CHECKING:
    from sphericalvision.capture.fusing import FusedCloud
    from sphericalvision.capture.rerun_log import RerunLog
    from sphericalvision.capture.splat import SplatScene
    from sphericalvision.capture.viewer import Timeline

__all__ = ["OUTPUTS", "Outputs", "Panoramas", "Settings", "prefix_of", "save_frame"]

OUTPUTS = (
    "panorama",
    "panorama_video",
    "depth",
    "confidence",
    "cloud",
    "glb",
    "mesh",
    "viewer",
    "npz",
    "video",
    "timeline",
    "rerun",
    "consistency",
    "fused",
    "splat",
)
FUSED = "fused.npz"
"""Beside the fused cloud: what a continuation goes on with."""
CUBE = 5.0
"""Side of the cubes of the fused cloud where none is given: so many steps between points at the nearest hypothesis."""
SHARES_HEADER = "frame,photo_consistency"
FILES = {
    "panorama": "panorama.png",
    "depth": "depth.png",
    "confidence": "confidence.png",
    "cloud": "points.ply",
    "glb": "points.glb",
    "mesh": "mesh.ply",
    "viewer": "viewer.html",
    "npz": "depth.npz",
    "splat": "splat/pinhole/transforms.json",
}
"""Output -> what the name of its file for a frame ends with; beside depth there is ``COLOR``."""
COLOR = "color.png"
RESTARTED = ("timeline", "rerun")
"""Outputs of all frames that cannot be continued: where one frame is left, all are; so is ``splat`` of posed frames."""
COLOURED = ("depth", "viewer", "video", "timeline")
"""Outputs that show depth in colours."""


class Settings(NamedTuple):
    """How results are written.

    Attributes:
        outputs: of ``OUTPUTS``.
        height: rows of panoramas.
        min_confidence: below which there are no points.
        voxel: side of the cubes of which each keeps one point, metres; of the fused cloud five times the
            distance between neighbouring points at the nearest hypothesis where it is not given.
        rate: frames a second of the video.
        near: metres, the red end of depth pictures; found in the first frame when not given.
        go_on: whether video, table of consistency and fused cloud begin with the frames that are there.
        basis: what results depend on beside settings, for ``FolderRecord``.
        axes: ``(3, 3)`` that turns what ``.ply`` files hold into a robot's axes.
        posed: whether frames are of one world, as their poses say: one ``splat`` of all of them then, with the fused
            cloud; else one of each.
    """

    outputs: Sequence[str]
    height: int = 320
    min_confidence: float = 0.0
    voxel: float | None = None
    rate: float = 10.0
    near: float | None = None
    go_on: bool = False
    basis: Mapping[str, str | None] = {}
    axes: Tensor | None = None
    posed: bool = False


class Panoramas:
    """Panoramas of one frame, each computed when something first wants it.

    Args:
        depth: of the frame.
        height: rows of the panoramas.
        near: metres, the red end of depth pictures; found in this frame when not given.
    """

    def __init__(self, depth: Depth, height: int, near: float | None = None) -> None:
        self.depth, self.height = depth, height
        self.near = near_end_of(depth) if near is None else near

    @cached_property
    def panorama(self) -> DepthImage:
        """Depth, confidence and what was seen."""
        return DepthImage(*(values.cpu() for values in self.depth.panorama(self.height)))

    @cached_property
    def colors(self) -> tuple[Tensor, Tensor]:
        """Colours ``(3, h, w)``, and where there are any."""
        return self._panorama_of(self.depth.images)

    @cached_property
    def stitched(self) -> npt.NDArray[Any]:
        """Colours ``(h, w, 3)``, uint8, as of cameras with one exposure and lenses without vignetting."""
        light = self.depth.compensations[0].light if self.depth.compensations else None
        if light is None:
            return as_bytes(self.colors[0])
        return as_bytes(self._panorama_of(light.corrected(self.depth.rig, self.depth.images))[0])

    def _panorama_of(self, images: Mapping[str, Tensor]) -> tuple[Tensor, Tensor]:
        on_cpu = {name: image.cpu() for name, image in images.items()}
        return rgb_panorama(self.depth.rig.to("cpu"), on_cpu, self.height, self.panorama.depth)

    @cached_property
    def depth_picture(self) -> npt.NDArray[Any]:
        """Depth in colours with a scale, greyer where it is less sure, grey where fewer than two cameras look."""
        image = self.panorama
        return depth_panorama(
            image.depth, self.near, strength=confidence_strength(image.confidence, image.seen)
        )


def save_frame(folder: Path, prefix: str, panoramas: Panoramas, settings: Settings) -> list[Path]:
    """Write the files of one frame, their names after ``prefix``; returns the paths."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = {
        output: folder / f"{prefix}{name}" for output, name in FILES.items() if output in settings.outputs
    }
    pictures: dict[Path, Tensor | npt.NDArray[Any]] = {}
    if "panorama" in paths:
        pictures[paths["panorama"]] = panoramas.stitched
    if "depth" in paths:
        pictures[folder / f"{prefix}{COLOR}"] = panoramas.colors[0]
        pictures[paths["depth"]] = panoramas.depth_picture
    if "confidence" in paths:
        sure = panoramas.panorama.confidence.where(panoramas.panorama.seen, math.nan)
        ticks = [(k / 4, f"{k / 4:g}") for k in range(5)]
        colors = colorize(sure.numpy(), "viridis")
        pictures[paths["confidence"]] = add_scale_bar(colors, "viridis", ticks, "confidence")
    for path, picture in pictures.items():
        write_image(path, picture)
    written = list(pictures)
    clouds = [paths[output] for output in ("cloud", "glb") if output in paths]
    if clouds:
        cloud = panoramas.depth.points(settings.min_confidence, voxel=settings.voxel)
        origin = panoramas.depth.rig.origin.cpu()
        written += _save_clouds(clouds, in_world(cloud, origin), origin, settings.axes)
    if "mesh" in paths:
        mesh = panoramas.depth.mesh(settings.min_confidence)
        for path in [paths["mesh"], paths["mesh"].with_suffix(".glb")] if len(mesh.faces) else ():
            placed = mesh.copy()  # as seen from the origin of the rig: trimesh writes float32
            placed.vertices = _placed(torch.from_numpy(mesh.vertices.copy()), path, settings.axes).numpy()
            with atomic_write(path) as temporary:
                placed.export(temporary)
            written.append(path)
    if "viewer" in paths:
        from sphericalvision.capture.viewer import save_viewer

        title = f"depth all around {prefix.rstrip('_')}".strip()
        written.append(save_viewer(paths["viewer"], panoramas.depth, settings.height, title, panoramas.near))
    if "npz" in paths:
        with atomic_write(paths["npz"]) as temporary:
            np.savez_compressed(temporary, **arrays_of(panoramas))
        written.append(paths["npz"])
    return written


def in_world(cloud: SurfacePoints, origin: Tensor) -> SurfacePoints:
    """Points as seen from the origin of a rig in the world of its file."""
    if not origin.any():
        return cloud
    return cloud._replace(points=cloud.points.cpu().double() + origin.cpu())


def _save_clouds(
    paths: Sequence[Path], cloud: SurfacePoints, origin: Tensor, axes: Tensor | None = None
) -> list[Path]:
    """Write a cloud by the suffixes of the paths, and return them; without points nothing is written."""
    written = []
    for path in paths if len(cloud.points) else ():
        points, normals = cloud.points, cloud.normals
        if path.suffix == ".glb":  # which holds float32
            points = (points - origin).float() if origin.any() else points
        points, normals = (_placed(vectors, path, axes) for vectors in (points, normals))
        written.append(save_point_cloud(path, points, cloud.colors, normals))
    return written


def _placed(vectors: Tensor, path: Path, axes: Tensor | None) -> Tensor:
    """Vectors ``(n, 3)`` in the axes of a file: of a ``.glb`` y up, looking along -z, as its viewers expect."""
    if path.suffix == ".glb":
        return vectors * vectors.new_tensor([1, -1, -1])
    return vectors if axes is None else vectors @ axes.to(vectors).mT


def arrays_of(panoramas: Panoramas) -> dict[str, Any]:
    """What ``depth.npz`` holds: the answer on the network's grid, and the panorama of depth."""
    depth, panorama = panoramas.depth, panoramas.panorama
    arrays = {
        "index": depth.index.flatten(),
        "inverse_depth": depth.inverse_depth.flatten(),
        "depth": depth.depth.flatten(),
        "confidence": depth.confidence.flatten(),
        "seen": depth.seen.flatten(),
        "directions": depth.directions.reshape(-1, 3),
        "depth_panorama": panorama.depth,
        "confidence_panorama": panorama.confidence.half(),
        "matched_panorama": panorama.seen,
        "center": depth.rig.in_world().center,
    }
    return {key: value.cpu().numpy() for key, value in arrays.items()}


def read_shares(path: Path) -> dict[str, float]:
    """Photo-consistency by frame, of a table whose last line may be torn; nothing if there is none.

    Raises:
        FileFormatError: it is no text.
    """
    shares: dict[str, float] = {}
    content = path.read_bytes() if path.is_file() else b""
    try:
        text = content[: content.rfind(b"\n") + 1].decode()
        for row in csv.reader(io.StringIO(text, newline="")):
            with suppress(ValueError):
                frame, share = row
                shares[frame] = float(share)
    except (UnicodeDecodeError, csv.Error) as error:
        raise FileFormatError(
            f"{path}: is damaged ({error}); delete it, and its frames are made again"
        ) from None
    return shares


def _rows_of(shares: Mapping[str, float]) -> str:
    """Lines of that table; names with a comma or a newline are in quotes."""
    rows = io.StringIO(newline="")
    csv.writer(rows, lineterminator="\n").writerows(
        (frame, f"{share:.4f}") for frame, share in shares.items()
    )
    return rows.getvalue()


class Outputs:
    """Writes frame after frame, and what is made of all of them.

    Args:
        folder: of the results.
        settings: how.

    Attributes:
        written: files so far.
        is_new: whether no frame came yet.
        shares: of the sphere that two cameras see, frame by frame.
        warnings: what is probably wrong, told from the first frame.
        seam: metres, of the first frame: the median depth where two cameras see, for which panoramas of them are right;
            nan where no panorama is written or no two cameras see.
        consistency: photo-consistency of each frame, for the output of that name.
        fused: the cloud of all frames, for the output of that name; None before there is one.

    Raises:
        ArgumentError: an unknown output, or results in the folder are of another basis.
        FileFormatError: the record, the table or the fused cloud that there is cannot be read.
    """

    def __init__(self, folder: Path, settings: Settings) -> None:
        for output in settings.outputs:
            check_choice("outputs", output, OUTPUTS)
        self.folder, self.settings = folder, settings
        self.written: list[Path] = []
        self.shares: list[float] = []
        self.near = settings.near
        self.warnings: list[str] = []
        self.seam = math.nan
        self._videos: dict[str, _Video] = {}
        self._timeline: Timeline | None = None
        self._recording: RerunLog | None = None
        self._splat: SplatScene | None = None
        self._restarted = (*RESTARTED, "splat") if settings.posed else RESTARTED
        self._number = 0
        self._names: list[str] = []
        self._intact: dict[str, bool] = {}
        self.is_new = True
        self._judge = PhotoConsistency()
        self._record = FolderRecord(folder, settings.basis, settings.go_on)
        self._table = folder / "consistency.csv"
        rows = read_shares(self._table) if settings.go_on else {}
        done = self._record.frames.get("consistency", {})
        self.consistency: dict[str, float] = {frame: share for frame, share in rows.items() if frame in done}
        if "consistency" in settings.outputs:
            self._write_shares()
        self.fused: FusedCloud | None = None
        if "fused" in settings.outputs and "fused" in self._record.frames and (folder / FUSED).is_file():
            from sphericalvision.capture.fusing import FusedCloud

            self.fused = FusedCloud.load(folder / FUSED)

    def has(self, frame: str) -> bool:
        """Whether every output has this frame: by the record, in files that are as they were written."""
        outputs = self.settings.outputs
        if "fused" in outputs and (self.fused is None or frame not in self.fused.frames):
            return False
        if "consistency" in outputs and frame not in self.consistency:
            return False
        if not all(frame in self._frames_of(output) for output in outputs):
            return False
        names = [FILES[output] for output in outputs if output in FILES]
        names += [COLOR] if "depth" in outputs else []
        return all(self._record.is_intact(f"{prefix_of(frame)}{name}") for name in names)

    def remaining(self, frames: Sequence[str]) -> set[str]:
        """Those of the frames that an output lacks."""
        frames_left = {frame for frame in frames if not self.has(frame)}
        restarted = any(output in self._restarted for output in self.settings.outputs)
        return set(frames) if frames_left and restarted else frames_left

    def _frames_of(self, output: str) -> Mapping[str, None]:
        """Frames that an output has by the record; none where its one file is not as it was written."""
        if output not in self._intact:
            file = self._record.files.get(output)
            self._intact[output] = file is None or self._record.is_intact(file)
        return self._record.frames.get(output, {}) if self._intact[output] else {}

    @property
    def follows_first_frame(self) -> bool:
        """Whether pictures have colours that the first frame decides."""
        return self.near is None and any(output in COLOURED for output in self.settings.outputs)

    def begin(self, depth: Depth) -> None:
        """Take the colours of all pictures from this frame, if it is the first."""
        self.is_new = False
        if self.near is None:
            self.near = near_end_of(depth)

    def write(self, frame: str, depth: Depth) -> None:
        """Write what there is to write of a frame."""
        self.begin(depth)
        with torch.inference_mode():
            panoramas = Panoramas(depth, self.settings.height, self.near)
            if not self.shares:
                self._warn(depth)
                if "panorama" in self.settings.outputs or "panorama_video" in self.settings.outputs:
                    self.seam = float(depth.depth[depth.seen].nanmedian())
            self.shares.append(depth.share_seen)
            for output, (name, picture_of) in _VIDEOS.items():
                if output in self.settings.outputs:
                    if output not in self._videos:
                        file, frames = self._record.files.get(output), self._frames_of(output)
                        video = _Video(self.folder, self.settings.rate, name, file, frames)
                        self._videos[output] = video
                        self.written.append(video.path)
                    self._videos[output].write(frame, picture_of(panoramas))
            if "timeline" in self.settings.outputs:
                if self._timeline is None:
                    from sphericalvision.capture.viewer import Timeline

                    title = f"depth all around: {self.folder.name}"
                    self._timeline = Timeline(self.settings.height, title, self.near)
                self._timeline.add(frame, depth)
            if "rerun" in self.settings.outputs:
                if self._recording is None:
                    from sphericalvision.capture.rerun_log import RerunLog

                    self._recording = RerunLog(self.folder / "depth.rrd", self.settings.height)
                self._recording.add(self._number, depth)
            if "consistency" in self.settings.outputs:
                self.consistency[frame] = self._judge(depth)
                with self._table.open("a") as table:  # what is there when the process is killed is read again
                    table.write(_rows_of({frame: self.consistency[frame]}))
            if "fused" in self.settings.outputs or (self.settings.posed and "splat" in self.settings.outputs):
                if self.fused is None:
                    from sphericalvision.capture.fusing import FusedCloud

                    step = math.sqrt(4 * math.pi / depth.index.numel()) * depth.min_depth
                    self.fused = FusedCloud(self.settings.voxel or CUBE * step)
                points = depth.points(self.settings.min_confidence)
                self.fused.add(frame, points, panoramas.panorama, depth.rig.center, depth.rig.origin)
                if "fused" in self.settings.outputs:
                    self.fused.save(self.folder / FUSED, now=False)
            self._number += 1
            self._names.append(frame)
            paths = save_frame(self.folder, prefix_of(frame), panoramas, self.settings)
            if "splat" in self.settings.outputs:
                paths += self._add_splat(frame, depth)
            self.written += paths
            each = [o for o in self.settings.outputs if o not in _VIDEOS and o not in self._restarted]
            if each:
                self._record.add(each, [frame], paths)

    def _add_splat(self, frame: str, depth: Depth) -> list[Path]:
        """Add a frame to the data set of all, or write its own."""
        posed, least = self.settings.posed, self.settings.min_confidence
        if self._splat is None:
            from sphericalvision.capture.splat import SplatScene

            self._splat = SplatScene(self.folder / "splat", least)
        if not posed:
            self._splat.folder = self.folder / f"{prefix_of(frame)}splat"
        self._splat.add(frame, depth)
        self.warnings += [note for note in self._splat.notes if note not in self.warnings]
        if posed:
            return []
        cloud = depth.points(least, voxel=self.settings.voxel)
        return self._splat.close(in_world(cloud, depth.rig.origin))

    def _warn(self, depth: Depth) -> None:
        """Say what is probably wrong, told from the first frame."""
        for warning in (ask(depth) for ask in OF_A_FRAME):
            if warning is not None:
                self.warnings.append(warning)

    def close(self) -> None:
        """Finish what is made of all frames."""
        for output, video in self._videos.items():
            video.close()
            self._record.replace(output, list(video.frames), video.path)
        if self._timeline is not None:
            self.written.append(self._timeline.save(self.folder / "timeline.html"))
            self._record.replace("timeline", self._names, self.written[-1])
        if self._recording is not None:
            self._recording.close()
            self.written.append(self._recording.path)
            self._record.replace("rerun", self._names, self._recording.path)
        if "consistency" in self.settings.outputs:
            self._write_shares()
            self.written.append(self._table)
        if self._splat is not None and self.settings.posed and self.fused is not None:
            self.written += self._splat.close(self.fused.points())
            self._record.replace("splat", self._names, self.folder / FILES["splat"])
        if self.fused is not None and "fused" in self.settings.outputs:
            self.fused.save(self.folder / FUSED)
            self.written += _save_clouds(
                [self.folder / "fused.ply", self.folder / "fused.glb"],
                self.fused.points(),
                self.fused.origin,
                self.settings.axes,
            )

    def _write_shares(self) -> None:
        write_bytes(self._table, f"{SHARES_HEADER}\n{_rows_of(self.consistency)}".encode())


class _Video:
    """A video, which is there once it is whole and its frames have been read back.

    It takes the place of ``file``, beginning with ``frames`` of it; without one it is called ``depth.mp4``, or by the
    first of ``depth_2.mp4``, ... that is free.
    """

    def __init__(
        self, folder: Path, rate: float, name: str, file: str | None = None, frames: Iterable[str] = ()
    ) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        names = (f"{name}.mp4" if number == 1 else f"{name}_{number}.mp4" for number in range(1, 10**6))
        self.path = folder / (file or next(name for name in names if not (folder / name).exists()))
        self.rate, self.frames = rate, dict.fromkeys(frames)
        self._whole = ExitStack()
        self._writer: cv2.VideoWriter | None = None
        self._number = 0

    def write(self, frame: str, picture: npt.NDArray[Any]) -> None:
        """Add a frame (h, w, 3), uint8, unless it is there already."""
        if frame in self.frames:
            return
        picture = np.pad(picture, [(0, size % 2) for size in picture.shape[:2]] + [(0, 0)], mode="edge")
        picture = cv2.cvtColor(np.ascontiguousarray(picture), cv2.COLOR_RGB2BGR)
        if self._writer is None:
            self._writer = self._opened(picture)
        self._add(self._writer, picture)
        self.frames[frame] = None

    def close(self) -> None:
        """Finish the file and give it its name.

        Raises:
            OSError: not all of its frames can be read back, as on a full disk, of which OpenCV says nothing.
        """
        if self._writer is None:
            return
        with self._whole:
            self._writer.release()
            number = sum(1 for _ in _frames_of(self._temporary))
            if number != self._number:
                raise OSError(
                    errno.ENOSPC, f"{number} of {self._number} frames could be written", str(self.path)
                )

    def _opened(self, picture: npt.NDArray[Any]) -> cv2.VideoWriter:
        """A writer for such pictures, with the frames of the video that it continues."""
        self._temporary = self._whole.enter_context(atomic_write(self.path))
        writer = cv2.VideoWriter(
            str(self._temporary), cv2.VideoWriter.fourcc(*"mp4v"), self.rate, picture.shape[1::-1]
        )
        if not writer.isOpened():
            self._temporary.unlink(missing_ok=True)
            raise FileFormatError(
                f"{self.path}: this OpenCV writes no MPEG-4 videos; leave video out of outputs"
            )
        for frame in _frames_of(self.path) if self.frames else ():
            self._add(writer, frame)
        if self._number != len(self.frames):
            raise FileFormatError(
                f"{self.path}: {self._number} of {len(self.frames)} frames can be read; delete it, and all frames are "
                "made again"
            )
        return writer

    def _add(self, writer: cv2.VideoWriter, picture: npt.NDArray[Any]) -> None:
        writer.write(picture)
        self._number += 1


def _colors_above_depth(panoramas: Panoramas) -> npt.NDArray[Any]:
    colors, depth = as_bytes(panoramas.colors[0]), panoramas.depth_picture
    side = (depth.shape[1] - colors.shape[1]) // 2  # the scale may be wider than a small panorama
    colors = np.pad(
        colors, ((0, 0), (side, depth.shape[1] - colors.shape[1] - side), (0, 0)), constant_values=255
    )
    return np.concatenate((colors, depth))


_VIDEOS = {
    "video": ("depth", _colors_above_depth),
    "panorama_video": ("panorama", lambda panoramas: panoramas.stitched),
}
"""Output -> name of the video, and what a frame of it shows."""


def _frames_of(path: Path) -> Iterator[npt.NDArray[Any]]:
    """The frames of a video, as long as it can be read."""
    video = cv2.VideoCapture(str(path))
    while (frame := video.read()[1]) is not None:
        yield frame
    video.release()


def prefix_of(frame: str) -> str:
    """What the names of a frame's files begin with."""
    return f"{frame}_" if frame else ""
