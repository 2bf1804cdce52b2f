# SPDX-License-Identifier: Apache-2.0
"""Writers: one for each output of a run, all in one table."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Callable, Mapping
from contextlib import ExitStack, suppress
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from sphericalvision.capture.checks import PhotoConsistency
from sphericalvision.capture.panoramas import Panoramas
from sphericalvision.capture.points import SurfacePoints
from sphericalvision.capture.result_folder import FUSED, ResultFolder
from sphericalvision.core import ArgumentError, FileFormatError
from sphericalvision.io.files import atomic_write, write_bytes
from sphericalvision.io.images import write_image
from sphericalvision.viz.color import colorize
from sphericalvision.viz.figure import add_scale_bar
from sphericalvision.viz.pointcloud import save_point_cloud

if TYPE_CHECKING:
    from sphericalvision.capture.rerun_log import RerunLog
    from sphericalvision.capture.splat import SplatScene
    from sphericalvision.capture.viewer import Timeline

CONSISTENCY = "consistency.csv"
CONSISTENCY_HEADER = "frame,photo_consistency"
FEW = 0.01
"""Fraction of the cubes of the fused cloud: frames that agree on fewer do not show one place."""


class Writer:
    """Makes one output of a run: files of each frame, or files of many frames.

    Args:
        name: of the output.
        results: the folder, and what its writers have in common.

    Attributes:
        files: what the names of a frame's files end with; none for an output of many frames.
        restarts: whether an output of many frames cannot be continued: where one frame is missing, all are made again.
    """

    files: ClassVar[tuple[str, ...]] = ()
    restarts = False

    def __init__(self, name: str, results: ResultFolder) -> None:
        self.name, self.results, self.settings = name, results, results.settings

    def has(self, frame: str) -> bool:
        """Whether this output has a frame, in a file that is there whole."""
        return all(self.results.frame_file(frame, file).is_file() for file in self.files)

    def add(self, frame: str, views: Panoramas) -> list[Path]:
        """Take a frame; returns the files that were written for it."""
        return self.write([self.results.frame_file(frame, file) for file in self.files], views)

    def write(self, paths: list[Path], views: Panoramas) -> list[Path]:
        """Write the files of a frame; returns those that were written."""
        raise NotImplementedError

    def close(self) -> list[Path]:
        """Finish the files of many frames, and return them."""
        return []

    def described(self) -> list[str]:
        """Sentences about all frames together."""
        return []


class SeamNote(Writer):
    """A writer of stitched panoramas, whose seams are right at one depth."""

    seam = math.nan

    def note_seam(self, views: Panoramas) -> None:
        """Keep the median depth of the first frame where two cameras see, metres."""
        if math.isnan(self.seam):
            self.seam = float(views.depth.depth[views.depth.seen].nanmedian())

    def described(self) -> list[str]:
        if not self.seam > 0:
            return []
        return [
            f"panorama: seams are at the depth estimated, {self.seam:.2f} m (median of the first frame, where two "
            "cameras see); surfaces nearer or farther than their estimate appear twice there, or are cut off"
        ]


class PanoramaWriter(SeamNote):
    files = ("panorama.png",)

    def write(self, paths: list[Path], views: Panoramas) -> list[Path]:
        self.note_seam(views)
        write_image(paths[0], views.stitched)
        return paths


class DepthWriter(Writer):
    files = ("color.png", "depth.png")

    def write(self, paths: list[Path], views: Panoramas) -> list[Path]:
        write_image(paths[0], views.colors[0])
        write_image(paths[1], views.depth_picture)
        return paths


class ConfidenceWriter(Writer):
    files = ("confidence.png",)

    def write(self, paths: list[Path], views: Panoramas) -> list[Path]:
        confidence = views.panorama.confidence.where(views.panorama.seen, math.nan)
        ticks = [(k / 4, f"{k / 4:g}") for k in range(5)]
        colors = colorize(confidence.numpy(), "viridis")
        write_image(paths[0], add_scale_bar(colors, "viridis", ticks, "confidence"))
        return paths


class CloudWriter(Writer):
    """Points of each frame; of a frame without points there is no file."""

    files = ("points.ply",)

    def write(self, paths: list[Path], views: Panoramas) -> list[Path]:
        cloud = views.points(self.settings.min_confidence, self.settings.voxel)
        origin = views.depth.rig.origin
        return save_clouds(paths, in_world(cloud, origin), origin.cpu(), self.settings.axes)


class GlbWriter(CloudWriter):
    files = ("points.glb",)


class MeshWriter(Writer):
    files = ("mesh.ply", "mesh.glb")

    def write(self, paths: list[Path], views: Panoramas) -> list[Path]:
        mesh = views.depth.mesh(self.settings.min_confidence)
        if not len(mesh.faces):
            return []
        vertices = torch.from_numpy(mesh.vertices.copy())
        for path in paths:
            placed = mesh.copy()  # as seen from the origin of the rig: trimesh writes float32
            placed.vertices = in_axes(vertices, path, self.settings.axes).numpy()
            with atomic_write(path) as temporary:
                placed.export(temporary)
        return paths


class ViewerWriter(Writer):
    files = ("viewer.html",)

    def write(self, paths: list[Path], views: Panoramas) -> list[Path]:
        from sphericalvision.capture.viewer import save_viewer

        title = f"depth all around {paths[0].name.removesuffix(self.files[0]).rstrip('_')}".strip()
        return [save_viewer(paths[0], views.depth, self.settings.height, title, views.near)]


class ArraysWriter(Writer):
    """The estimate on the network's grid, and the panorama of depth."""

    files = ("depth.npz",)

    def write(self, paths: list[Path], views: Panoramas) -> list[Path]:
        depth, panorama = views.depth, views.panorama
        tensors = {
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
        arrays: dict[str, Any] = {key: values.cpu().numpy() for key, values in tensors.items()}
        with atomic_write(paths[0]) as temporary:
            np.savez_compressed(temporary, **arrays)
        return paths


class SequenceWriter(Writer):
    """An output with one file for many frames, ``<stem>.<suffix>``; further parts are ``<stem>_2.<suffix>``, ..."""

    stem: ClassVar[str]
    suffix: ClassVar[str]

    def __init__(self, name: str, results: ResultFolder) -> None:
        super().__init__(name, results)
        self._names: list[str] = []
        self.part = 1

    def path(self, part: int) -> Path:
        """The file of a part, counted from 1."""
        return self.results.path / f"{self.stem}{'' if part == 1 else f'_{part}'}{self.suffix}"

    def has(self, frame: str) -> bool:
        entries = self.results.frames(self.name).items()
        return any(frame in names and self.path(part).is_file() for part, names in entries)

    def add(self, frame: str, views: Panoramas) -> list[Path]:
        if self.restarts or not self.has(frame):
            if not self._names:
                self.begin(views)
            self.append(frame, views)
            self._names.append(frame)
        return []

    def begin(self, views: Panoramas) -> None:
        """Open the file, by the first frame that comes."""
        raise NotImplementedError

    def append(self, frame: str, views: Panoramas) -> None:
        """Write a frame into the file."""
        raise NotImplementedError

    def close(self) -> list[Path]:
        if not self._names:
            return []
        path = self.finish()
        self.results.state(self.name, self.part, self._names)
        return [path]

    def finish(self) -> Path:
        """Give the file its name, and return it."""
        raise NotImplementedError


class VideoWriter(SequenceWriter):
    """A video; a continued run writes the frames that it lacks to another one."""

    stem, suffix = "depth", ".mp4"
    picture: Callable[[Panoramas], npt.NDArray[Any]] = staticmethod(lambda views: views.colors_above_depth)

    def begin(self, views: Panoramas) -> None:
        try:
            import av
        except ImportError:
            raise ArgumentError(f"{self.name}: needs PyAV; pip install av") from None

        self._av, self._open = av, ExitStack()
        self.part = next(part for part in range(1, 10**6) if not self.path(part).exists())
        temporary = self._open.enter_context(atomic_write(self.path(self.part)))
        height, width = (side + side % 2 for side in self.picture(views).shape[:2])
        try:
            self._container = av.open(str(temporary), "w", format="mp4")
            rate = Fraction(self.settings.rate).limit_denominator(1000)
            # With its tree of macroblocks x264 writes other bits of the same pictures from run to run.
            options = {"crf": "18", "preset": "fast", "x264-params": "mbtree=0"}
            self._stream = self._container.add_stream("libx264", rate, options=options)
        except (av.FFmpegError, ValueError) as error:
            temporary.unlink(missing_ok=True)
            raise FileFormatError(
                f"{self.path(self.part)}: this PyAV writes no H.264 videos ({error}); leave {self.name} out of outputs"
            ) from None
        self._stream.width, self._stream.height, self._stream.pix_fmt = width, height, "yuv420p"
        self._stream.thread_count = 1  # the network has the cores

    def append(self, frame: str, views: Panoramas) -> None:
        picture = self.picture(views)
        picture = np.pad(picture, [(0, size % 2) for size in picture.shape[:2]] + [(0, 0)], mode="edge")
        image = self._av.VideoFrame.from_ndarray(np.ascontiguousarray(picture), "rgb24")
        self._container.mux(self._stream.encode(image))

    def finish(self) -> Path:
        with self._open:
            self._container.mux(self._stream.encode())
            self._container.close()
        return self.path(self.part)


class PanoramaVideoWriter(SeamNote, VideoWriter):
    stem = "panorama"
    picture = staticmethod(lambda views: views.stitched)

    def append(self, frame: str, views: Panoramas) -> None:
        self.note_seam(views)
        super().append(frame, views)


class TimelineWriter(SequenceWriter):
    stem, suffix = "timeline", ".html"
    _page: Timeline
    restarts = True

    def begin(self, views: Panoramas) -> None:
        from sphericalvision.capture.viewer import Timeline

        title = f"depth all around: {self.results.path.name}"
        self._page = Timeline(self.settings.height, title, views.near)

    def append(self, frame: str, views: Panoramas) -> None:
        self._page.add(frame, views.depth)

    def finish(self) -> Path:
        return self._page.save(self.path(1))


class RerunWriter(SequenceWriter):
    stem, suffix = "depth", ".rrd"
    _log: RerunLog
    restarts = True

    def begin(self, views: Panoramas) -> None:
        from sphericalvision.capture.rerun_log import RerunLog

        self._log = RerunLog(self.path(1), self.settings.height)

    def append(self, frame: str, views: Panoramas) -> None:
        self._log.add(len(self._names), views.depth)

    def finish(self) -> Path:
        self._log.close()
        return self._log.path


class ConsistencyWriter(Writer):
    """The table of photo-consistency; a row is appended as soon as its frame comes."""

    def __init__(self, name: str, results: ResultFolder) -> None:
        super().__init__(name, results)
        self._path = results.path / CONSISTENCY
        self._measure = PhotoConsistency()
        self.shares = read_shares(self._path) if self.settings.go_on else {}
        self._write()

    def has(self, frame: str) -> bool:
        return frame in self.shares

    def add(self, frame: str, views: Panoramas) -> list[Path]:
        self.shares[frame] = self._measure(views.depth)
        with self._path.open("a") as table:  # a process that is killed loses no row
            table.write(_rows_of({frame: self.shares[frame]}))
        return []

    def close(self) -> list[Path]:
        self._write()
        return [self._path]

    def described(self) -> list[str]:
        if not self.shares:
            return []
        mean = sum(self.shares.values()) / len(self.shares)
        return [
            f"photo-consistency: {mean:.3f} of what winner-takes-all reaches, mean of {len(self.shares)} frame(s)"
        ]

    def _write(self) -> None:
        write_bytes(self._path, f"{CONSISTENCY_HEADER}\n{_rows_of(self.shares)}".encode())


class FusedWriter(Writer):
    """One cloud of all frames, and the state that a continuation starts from."""

    def has(self, frame: str) -> bool:
        return self.results.fused is not None and frame in self.results.fused.frames

    def add(self, frame: str, views: Panoramas) -> list[Path]:
        self.results.fuse(frame, views).save(self.results.path / FUSED, now=False)
        return []

    def close(self) -> list[Path]:
        if (fused := self.results.fused) is None:
            return []
        fused.save(self.results.path / FUSED)
        paths = [self.results.path / "fused.ply", self.results.path / "fused.glb"]
        return save_clouds(paths, fused.points(), fused.origin, self.settings.axes)

    def described(self) -> list[str]:
        if (fused := self.results.fused) is None:
            return []
        count = len(fused.points().points)
        is_few = count <= FEW * len(fused)
        doubt = "; these are few: do the frames show one place? If so, set a larger voxel=" if is_few else ""
        return [
            f"fused: {count} points of {len(fused.frames)} frame(s), one for each cube of {100 * fused.side:.1f} cm "
            f"that frames agree on, of {len(fused)}{doubt}"
        ]


class SplatWriter(Writer):
    """A data set for splatting of each frame, or, where frames have poses, of all with the fused cloud."""

    files = ("splat/pinhole/transforms.json",)

    def __init__(self, name: str, results: ResultFolder) -> None:
        super().__init__(name, results)
        self.restarts = self.settings.posed
        self._scene: SplatScene | None = None
        self._names: list[str] = []

    def has(self, frame: str) -> bool:
        if not self.settings.posed:
            return super().has(frame)
        names = self.results.frames(self.name).get(1, [])
        return frame in names and (self.results.path / self.files[0]).is_file()

    def add(self, frame: str, views: Panoramas) -> list[Path]:
        if self._scene is None:
            from sphericalvision.capture.splat import SplatScene

            self._scene = SplatScene(self.results.path / "splat", self.settings.min_confidence)
        if not self.settings.posed:
            self._scene.folder = self.results.frame_file(frame, "splat")
        self._scene.add(frame, views.depth)
        self._names.append(frame)
        if self.settings.posed:
            self.results.fuse(frame, views)
            return []
        cloud = views.points(self.settings.min_confidence, self.settings.voxel)
        return self._scene.close(in_world(cloud, views.depth.rig.origin))

    def close(self) -> list[Path]:
        if self._scene is None or not self.settings.posed or self.results.fused is None:
            return []
        paths = self._scene.close(self.results.fused.points())
        self.results.state(self.name, 1, self._names)
        return paths

    def described(self) -> list[str]:
        return [] if self._scene is None else [f"Warning: {note}" for note in self._scene.notes]


WRITERS: Mapping[str, type[Writer]] = {
    "panorama": PanoramaWriter,
    "panorama_video": PanoramaVideoWriter,
    "depth": DepthWriter,
    "confidence": ConfidenceWriter,
    "cloud": CloudWriter,
    "glb": GlbWriter,
    "mesh": MeshWriter,
    "viewer": ViewerWriter,
    "npz": ArraysWriter,
    "video": VideoWriter,
    "timeline": TimelineWriter,
    "rerun": RerunWriter,
    "consistency": ConsistencyWriter,
    "fused": FusedWriter,
    "splat": SplatWriter,
}
"""Output -> what writes it, in the order in which they write a frame."""
OUTPUTS = tuple(WRITERS)


def in_world(cloud: SurfacePoints, origin: Tensor) -> SurfacePoints:
    """Points as seen from the origin of a rig in the world of its file."""
    if not origin.any():
        return cloud
    return cloud._replace(points=cloud.points.cpu().double() + origin.cpu())


def save_clouds(
    paths: list[Path], cloud: SurfacePoints, origin: Tensor, axes: Tensor | None = None
) -> list[Path]:
    """Write a cloud by the suffixes of the paths, and return them; without points nothing is written."""
    written = []
    for path in paths if len(cloud.points) else ():
        points = cloud.points
        if path.suffix == ".glb":  # which holds float32
            points = (points - origin).float() if origin.any() else points
        points, normals = (in_axes(vectors, path, axes) for vectors in (points, cloud.normals))
        written.append(save_point_cloud(path, points, cloud.colors, normals))
    return written


def in_axes(vectors: Tensor, path: Path, axes: Tensor | None) -> Tensor:
    """Vectors ``(n, 3)`` in the axes of a file: of a ``.glb`` y up, looking along -z, as its viewers expect."""
    if path.suffix == ".glb":
        return vectors * vectors.new_tensor([1, -1, -1])
    return vectors if axes is None else vectors @ axes.to(vectors).mT


def read_shares(path: Path) -> dict[str, float]:
    """Photo-consistency by frame, of a table whose last line may be torn; nothing if there is none."""
    fractions: dict[str, float] = {}
    content = path.read_bytes() if path.is_file() else b""
    try:
        text = content[: content.rfind(b"\n") + 1].decode()
        for row in csv.reader(io.StringIO(text, newline="")):
            with suppress(ValueError):
                frame, share = row
                fractions[frame] = float(share)
    except (UnicodeDecodeError, csv.Error) as error:
        raise FileFormatError(
            f"{path}: is damaged ({error}); delete it, and its frames are made again"
        ) from None
    return fractions


def _rows_of(shares: Mapping[str, float]) -> str:
    """Lines of that table; names with a comma or a newline are in quotes."""
    rows = io.StringIO(newline="")
    lines = ((frame, f"{share:.4f}") for frame, share in shares.items())
    csv.writer(rows, lineterminator="\n").writerows(lines)
    return rows.getvalue()
