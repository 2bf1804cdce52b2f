# SPDX-License-Identifier: Apache-2.0
"""Cameras and rigs from pictures of a board: the work behind ``sphericalvision-calibrate``."""

import glob
import math
import re
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Annotated, NamedTuple

import torch
from pydantic.dataclasses import dataclass
from torch import Tensor

from sphericalvision.cameras import CameraRig, save_camera, save_rig
from sphericalvision.cameras.calibration import CAMERA_FORMATS, RIG_FORMATS
from sphericalvision.cameras.registry import camera_model_names
from sphericalvision.capture import calibrate_rig
from sphericalvision.capture.calibrating.boards import Board, Charuco, Checkerboard, read_board
from sphericalvision.capture.calibrating.refine import FEWEST, RefinedRig
from sphericalvision.capture.sources.joined_views import rig_of_views, split_views
from sphericalvision.capture.sources.videos import VIDEO_SUFFIXES, Videos, read_streams
from sphericalvision.core import ArgumentError, MissingFileError, check_choice
from sphericalvision.geometry import angle_from_axis
from sphericalvision.io.files import by_numbers
from sphericalvision.io.images import read_image
from sphericalvision.recipes.app.captures import evenly_chosen, print_labels
from sphericalvision.recipes.app.cli import console, print_table
from sphericalvision.recipes.app.kinds import STRICT, Count, FullAngle, Names, OnlyWith, Positive, Text
from sphericalvision.recipes.app.rigs import keys_named


@dataclass(frozen=True, kw_only=True, config=STRICT)
class CalibrateConfig:
    """Keys of ``conf/calibrate.yaml``."""

    images: Text
    cameras: Names | None
    num_frames: Count
    board: Text
    square: Positive | None
    marker: Positive | None
    dictionary: Annotated[Text, OnlyWith("marker")]
    to: Text
    field_of_view_deg: FullAngle
    num_coefficients: Count | None
    projection: Annotated[Text | None, OnlyWith("to=fisheye")]
    output: Text
    format: Text | None


LONE = "camera"
"""Name of the camera of a pattern without ``{camera}``."""
RING_DEG = 20
SECTORS = ("right", "lower right", "down", "lower left", "left", "upper left", "up", "upper right")
"""Parts of an image in the report: rings about the axis, and directions from it."""
TOO_FAR = 1.0
"""Pixels of RMS from which on something else is wrong than noise."""
MOVED = 0.3
"""Pixels by which corners differ at least, in the mean, on two pictures of which one is no copy of the other."""
MAX_PICTURES = 5
"""Pictures that are listed, those with the largest errors."""


class Moment(NamedTuple):
    """Pictures of one moment: camera -> name of its picture, and the picture, ``(3, h, w)`` in [0, 1]."""

    labels: Mapping[str, str]
    images: Mapping[str, Tensor]


class Pictures(NamedTuple):
    """Corners on all pictures, by moment and camera."""

    labels: list[Mapping[str, str]]
    """By moment: camera -> name of its picture."""
    sizes: dict[str, tuple[int, int]]
    pixels: Tensor
    """(n, cameras, m, 2)."""
    seen: Tensor
    """(n, cameras, m)."""


def calibrate(config: CalibrateConfig) -> RefinedRig:
    """Find the board in ``config.images``, calibrate, print how well that went, and write ``config.output``.

    Raises:
        ArgumentError: the board is found on less than three pictures of a camera, or cameras never see it together.
    """
    check_choice("to", config.to, camera_model_names())
    board = board_of(config)
    files = _files(config.images)
    names = sorted({name for cameras in files.values() for name in cameras})
    if config.cameras is not None:
        if names != [LONE]:
            raise ArgumentError(
                "cameras: they are those in one picture or video; a pattern with {camera} names the cameras itself"
            )
        names = list(map(str, config.cameras))
    if config.format is not None:
        check_choice("format", config.format, CAMERA_FORMATS if names == [LONE] else RIG_FORMATS)
    pictures = _read(
        _moments(files, [] if config.cameras is None else names, config.num_frames), names, board
    )
    with keys_named(pixels="images"):
        result = calibrate_rig(
            board.points,
            pictures.pixels,
            pictures.sizes,
            config.to,
            pictures.seen,
            field_of_view=math.radians(config.field_of_view_deg),
            num_coefficients=config.num_coefficients,
            projection=config.projection,
        )
    _report(result, pictures)
    if names == [LONE]:
        save_camera(result.rig.cameras[LONE], config.output, config.format)
    else:
        save_rig(result.rig, config.output, config.format)
    console.print(f"written as {config.format or 'native'}")
    print(config.output)
    return result


def board_of(config: CalibrateConfig) -> Board:
    """The board of a configuration: a target file, or inner corners with the side of squares and markers."""
    name = config.board
    if name.lower().endswith((".yaml", ".yml")):
        for key in ("square", "marker"):
            if (value := getattr(config, key)) is not None:
                raise ArgumentError(
                    f"{key}: the target file {name} says it, got {value:g} beside it; leave it out"
                )
        return read_board(name)
    match = re.fullmatch(r"\s*(\d+)\s*x\s*(\d+)\s*", name)
    if not match or min(int(match[1]), int(match[2])) < 3:
        raise ArgumentError(
            "board: expected inner corners as COLUMNSxROWS, 3 or more, such as 9x6, or a target file of Kalibr, "
            f"target.yaml, got {name!r}"
        )
    if config.square is None:
        raise ArgumentError("square: expected the side of a square in metres, such as 0.03")
    columns, rows = int(match[1]), int(match[2])
    if config.marker is None:
        return Checkerboard(columns, rows, config.square)
    return Charuco(columns, rows, config.square, config.marker, config.dictionary.upper())


def _files(pattern: str) -> dict[str, dict[str, Path]]:
    """Moment -> camera -> file, for a pattern with ``*``, ``?`` or ``{frame}`` and, of a rig, ``{camera}``."""
    wild, expression = "", ""
    for token in re.split(r"(\{frame[^}]*\}|\{camera\}|\*\*/|[*?])", str(Path(pattern))):
        if token == "{camera}":
            wild += "*"
            expression += "(?P=camera)" if "<camera>" in expression else "(?P<camera>[^/]+)"
        elif token in ("**/", "?"):
            wild += token
            expression += "(.*)" if token == "**/" else "([^/])"
        elif token == "*" or token.startswith("{frame"):
            wild += "*"
            expression += "([^/]*)"
        else:
            wild += glob.escape(token)
            expression += re.escape(token)
    files: dict[str, dict[str, Path]] = {}
    for path in sorted(glob.glob(wild, recursive=True), key=by_numbers):
        if (match := re.fullmatch(expression, path)) is None:
            continue  # of another camera than the folder that it is in
        camera = match.groupdict().get("camera", LONE)
        camera_group = match.re.groupindex.get("camera")
        moment = " ".join(text for index, text in enumerate(match.groups(), 1) if index != camera_group)
        files.setdefault(moment, {})[camera] = Path(path)
    if not files:
        raise MissingFileError(
            f"images: no file like {pattern!r}; a pattern such as board/*.png or, of a rig, board/{{camera}}/*.png is "
            "expected"
        )
    return files


def _moments(files: Mapping[str, Mapping[str, Path]], views: list[str], num_frames: int) -> Iterator[Moment]:
    """The pictures of ``files``, moment -> camera -> picture or video, and ``num_frames`` of each video.

    ``views`` are names of cameras whose views each of them holds; empty where it holds those of one.
    """
    for cameras in files.values():
        if all(path.suffix.lower() in VIDEO_SUFFIXES for path in cameras.values()):
            yield from _of_videos(cameras, views, num_frames)
            continue
        images = {name: read_image(path, what="a picture of the board") for name, path in cameras.items()}
        labels = {name: str(path) for name, path in cameras.items()}
        if views:
            picture = images[LONE].movedim(0, -1)
            cropped = split_views(picture, rig_of_views(views, picture.shape[:2]))
            images = {name: view.movedim(-1, 0) for name, view in cropped.items()}
            labels = {name: f"{labels[LONE]} ({name})" for name in views}
        yield Moment(labels, images)


def _of_videos(files: Mapping[str, Path], views: list[str], num_frames: int) -> Iterator[Moment]:
    if views:
        source = Videos({"": files[LONE]}, rig_of_views(views, (8, 8 * len(views))))
        if "" in source.streams:
            source.whole = source.rig = rig_of_views(views, source.streams[""].size)
        print_labels(source)
    elif list(files) == [LONE] and (count := len(read_streams(files[LONE]))) > 1:
        raise ArgumentError(
            f"cameras: {files[LONE]} has {count} video streams; name their cameras, [front,back]"
        )
    else:
        source = Videos(files, rig_of_views(list(files), (8, 8 * len(files))))
    for frame in evenly_chosen(source, num_frames):
        if frame.images is None:
            raise frame.error or ArgumentError(f"images: frame {frame.name} has none")
        images = {name: torch.from_numpy(image).movedim(-1, 0) / 255 for name, image in frame.images.items()}
        yield Moment({name: f"frame {frame.name} of {name}" for name in images}, images)


def _read(moments: Iterable[Moment], names: list[str], board: Board) -> Pictures:
    sizes: dict[str, tuple[int, int]] = {}
    last: dict[str, Tensor] = {}
    labels: list[Mapping[str, str]] = []
    shape = len(names), len(board.points)
    pixels, seen = [torch.zeros(0, *shape, 2).double()], [torch.zeros(0, *shape).bool()]
    with console.status("looking for the board"):
        for moment in moments:
            labels.append(moment.labels)
            pixels.append(torch.zeros(1, *shape, 2).double())
            seen.append(torch.zeros(1, *shape).bool())
            for name, image in moment.images.items():
                height, width = sizes.setdefault(name, (image.shape[-2], image.shape[-1]))
                if image.shape[-2:] != (height, width):
                    raise ArgumentError(
                        f"images: {moment.labels[name]} has {image.shape[-1]} x {image.shape[-2]} pixels (width x "
                        f"height), expected {width} x {height}, the size of the first picture of {name}"
                    )
                index, last[name] = names.index(name), image
                pixels[-1][0, index], seen[-1][0, index] = board.find(image)
    corners, valid = torch.cat(pixels), torch.cat(seen)
    for index, name in enumerate(names):
        count = sum(name in moment for moment in labels)
        boards = int((valid[:, index].sum(-1) >= FEWEST).sum())
        if boards < 3:
            raise ArgumentError(
                f"images: the board is found on {boards} of {count} pictures of {name}, and three are needed, better "
                f"twenty; {board.remedy(last[name]) if name in last else 'there are none'}"
            )
    return Pictures(labels, {name: sizes[name] for name in names}, corners, valid)


def _report(result: RefinedRig, pictures: Pictures) -> None:
    """Print errors by picture and over each image, parts without corners, and poses of the cameras."""
    used = result.residuals.abs().sum(-1) > 0
    squares = result.residuals.square().sum(-1)
    errors = (squares.sum(-1) / used.sum(-1)).sqrt()  # nan where there is no board
    names = list(pictures.sizes)
    rows = [
        [moment[name], f"{errors[row, index]:.3f}"]
        for row, moment in enumerate(pictures.labels)
        for index, name in enumerate(names)
        if bool(used[row, index].any())
    ]
    rows.sort(key=lambda row: -float(row[1]))
    count = sum(map(len, pictures.labels))
    print_table(
        f"boards on {len(rows)} of {count} pictures; the worst", ["picture", "RMS (px)"], rows[:MAX_PICTURES]
    )
    for index, (name, camera) in enumerate(result.rig.cameras.items()):
        rms = float((squares[:, index].sum() / used[:, index].sum()).sqrt())
        console.print(
            f"{name}: {type(camera).__name__}, RMS {rms:.3f} px of {int(used[:, index].sum())} corners, sees "
            f"{2 * math.degrees(camera.max_angle):.1f}°"
        )
        for key in camera.intrinsic_names:
            if (values := getattr(camera, key)) is not None:
                console.print(f"  {key}: {', '.join(f'{value:.6g}' for value in values.flatten().tolist())}")
        _print_image(
            name,
            result.rig,
            index,
            pictures.pixels[:, index][used[:, index]],
            squares[:, index][used[:, index]],
        )
    if left_out := int((pictures.seen & ~used).sum()):
        console.print(
            f"{left_out} of {int(pictures.seen.sum())} corners left out: too far off, or too few on a picture"
        )
    astray = [
        moment[name]
        for row, moment in enumerate(pictures.labels)
        for index, name in enumerate(names)
        if int(pictures.seen[row, index].sum()) >= FEWEST and not bool(used[row, index].any())
    ]
    if astray:
        some = ", ".join(astray[:MAX_PICTURES]) + (" ..." if len(astray) > MAX_PICTURES else "")
        print(
            f"Warning: {some} left out: the board stands elsewhere than in the others' pictures of the moment"
        )
    for index, name in enumerate(names):
        counts = pictures.seen[:, index].sum(-1)
        corners = (pictures.pixels * pictures.seen[..., None])[:, index].flatten(1)
        near = torch.cdist(corners, corners, p=1) < 2 * MOVED * counts
        if (copies := near.triu(1).nonzero()).numel():
            first, second = (pictures.labels[row][name] for row in copies[0].tolist())
            print(
                f"Warning: {len(copies[:, 1].unique())} of {len(corners)} pictures of {name} show the board where "
                f"others do, such as {first} and {second}: copies count twice, leave them out"
            )
    for line in _poses(result.rig, used):
        console.print(line)
    console.print(f"RMS {result.rms_error:.3f} px")
    if result.rms_error > TOO_FAR:
        print(
            f"Warning: RMS above {TOO_FAR:g} px: check board=, field_of_view_deg=, and that pictures are of one moment."
        )


def _print_image(name: str, rig: CameraRig, index: int, pixels: Tensor, squares: Tensor) -> None:
    """A table of RMS by ring about the axis and direction in the image, and a line about what has no corners."""
    camera = rig.cameras[name]
    rays = camera.unproject(pixels.to(camera.max_angle)).directions
    ring = (angle_from_axis(rays).rad2deg() / RING_DEG).long()
    sector = ((torch.atan2(rays[:, 1], rays[:, 0]) / (2 * math.pi) * len(SECTORS)).round().long()) % len(
        SECTORS
    )
    rows, bare = [], []
    for step in range(int(ring.max()) + 1):
        cells = [(ring == step) & (sector == octant) for octant in range(len(SECTORS))]
        label = f"{RING_DEG * step}-{RING_DEG * (step + 1)}°"
        rows.append([label, *(f"{squares[cell].mean().sqrt():.2f}" if cell.any() else "-" for cell in cells)])
        bare += [f"{label} {SECTORS[octant]}" for octant, cell in enumerate(cells) if not cell.any()]
    print_table(f"{name}: RMS (px) by angle from the axis and direction", ["", *SECTORS], rows)
    if bare:
        console.print(
            f"no corners of {name} in {len(bare)} of {len(rows) * len(SECTORS)} parts: {', '.join(bare[:6])}"
            f"{' ...' if len(bare) > 6 else ''}; nothing is known of the lens there"
        )


def _poses(rig: CameraRig, used: Tensor) -> Iterator[str]:
    """A line for each camera but the first: where it is, and how often the board was seen by both."""
    boards = used.sum(-1) >= FEWEST
    angles = angle_from_axis(rig.axes @ rig.world_from_camera[0, :3, :3]).rad2deg()
    for index, name in enumerate(rig.names[1:], start=1):
        distance = float((rig.positions[index] - rig.positions[0]).norm())
        ties = [
            f"{int((boards[:, index] & boards[:, other]).sum())} with {rig.names[other]}"
            for other in range(len(rig))
            if other != index and bool((boards[:, index] & boards[:, other]).any())
        ]
        yield (
            f"{name}: axis {angles[index]:.2f}° from {rig.names[0]}'s, {distance:.4f} m away; boards seen by both: "
            f"{', '.join(ties)}"
        )
