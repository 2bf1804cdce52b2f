# SPDX-License-Identifier: Apache-2.0
"""Files by a pattern such as ``cam{camera}/{frame:05d}.png``: which file is of which camera and frame."""

from __future__ import annotations

import os
import re
import string
import warnings
from collections.abc import Collection, Container, Iterable, Mapping, Sequence
from pathlib import Path

from sphericalvision.capture.sources.listings import listed_clock
from sphericalvision.capture.sources.moments import WHOLE_SECONDS, Clock, Moments, pair_moments
from sphericalvision.core import ArgumentError, MissingFileError
from sphericalvision.io.images import read_exif_time
from sphericalvision.io.times import SAME_TIME, are_counts, in_order, seconds

EXAMPLE = "'capture/cam{camera}/{frame:05d}.png'"
FREE_RUNNING = 0.25
"""Seconds by which pictures of one moment may differ that cameras take each by its own interval."""
_NUMBER = re.compile(r"^-?\d+(?:\.\d+)*|\d+(?:\.\d+)*")
"""In a frame's name; a time with decimals is one."""
_IMAGE_WORDS = (
    "cam|camera|image|img|picture|frame|raw|rect|colou?r|rgb|bgr|mono|gr[ae]y|compressed|dsc|vid|dji|pxl"
)
"""What names of images say that is no part of a camera's name."""


def is_called(name: str, camera: str) -> bool:
    """Whether a name is a camera's and no other's: behind namespaces are the camera's words and those of images alone.

    Examples:
        >>> [is_called(topic, "left") for topic in ("/rig/cam_left/image_raw", "/left_rear/image_raw")]
        [True, False]
    """
    images = rf"(?:(?:{_IMAGE_WORDS})[\W_]*)*"
    words = r"[\W_]*".join(re.findall(r"[^\W\d_]+|\d+", camera.lower())) or re.escape(camera)
    return re.fullmatch(rf"(?:.*/)?[\W_]*{images}{words}[\W_]*{images}", name.lower()) is not None


def find_files(
    pattern: str,
    names: Sequence[str],
    frames: Iterable[int | str] | None = None,
    leave_out: Iterable[Path] = (),
    key: str = "images",
    labels: Mapping[str, str] | None = None,
    tolerance: float = SAME_TIME,
) -> Moments:
    """Find the frames that every camera has, or the requested ones, in their order.

    ``{camera}`` stands for a label of ``find_labels``. ``{frame}`` stands for the frame, with a width if it has one
    (``{frame:05d}``); it may be missing when there is one frame only. Frames of equal names belong together; where
    cameras have other names and all are times, or where names are numbers and a table next to the images tells their
    times (``listed_clock``), those within ``tolerance``, called as the first camera's.

    Args:
        pattern: of the files.
        names: cameras, in order.
        frames: requested frames, by number or name; all when not given.
        leave_out: files that are no images, such as masks in the same folder.
        key: that the pattern was given by, for messages.
        labels: of ``find_labels``, of the whole rig; by default of ``names``.
        tolerance: seconds between images of one moment, at most.

    Raises:
        ArgumentError: the pattern has no ``{camera}``, or other fields.
        MissingFileError: there are no files, or a requested frame is missing.
    """
    requested = None if frames is None else [_frame_text(pattern, frame) for frame in frames]
    excluded = {os.path.realpath(path) for path in leave_out}
    if labels is None:
        labels = find_labels(pattern, names, leave_out=leave_out, key=key)
    files = {name: files_of(pattern, labels[name], excluded) for name in names}
    if requested is None:
        _check_one_kind(files, pattern, key)
    clocks = _clocks(files, labels)
    moments = pair_moments(files, clocks, tolerance, key)
    if not clocks:  # equal names say themselves what belongs together
        moments = moments._replace(pairing="")
    if requested is None:
        if moments.clock is None and "frame" in _fields(pattern, key):
            moments.warnings.extend(_say_if_taken_apart(list(moments.frames.values()), key))
        return moments
    for frame in requested:
        if frame in moments.frames:
            continue
        camera = next((name for name in names if frame not in files[name]), None)
        if camera is None:
            raise MissingFileError(
                f"{key}: frame {frame} has no image of every camera at one time; correct frames="
            )
        existing = in_order(files[camera])
        hint = ", ".join(existing[:4])
        similar = [name for name in existing if name != frame and name.lstrip("0") == frame.lstrip("0")]
        if similar:
            hint += f"; {{frame:0{len(similar[0])}d}} in the pattern stands for {similar[0]}"
        values = {"camera": labels[camera], "frame": frame, None: ""}
        path = "".join(text + values[field] for text, field, _, _ in string.Formatter().parse(pattern))
        raise MissingFileError(
            f"{key}: {path}: no such file. The first frames there are {hint}. Correct frames= or the pattern"
        )
    return moments._replace(frames={frame: moments.frames[frame] for frame in requested}, warnings=[])


def _say_if_taken_apart(frames: Sequence[Mapping[str, Path]], key: str) -> list[str]:
    """A sentence on pictures of one name, between which EXIF tells other times in one frame than in another."""
    chosen = [frames[k * (len(frames) - 1) // 8] for k in range(9)]
    for camera in frames[0]:
        pairs = [[read_exif_time(file) for file in (next(iter(f.values())), f[camera])] for f in chosen]
        apart = [time - own for own, time in pairs if own is not None and time is not None]
        is_whole = all(time is None or time % 1 == 0 for pair in pairs for time in pair)
        if apart and (gap := max(apart) - min(apart)) > (WHOLE_SECONDS if is_whole else FREE_RUNNING):
            return [
                f"{key}: pictures are paired by names, but by EXIF those of {camera} come up to {gap:.3g} s later in "
                "some frames than in others; did a camera miss one? Name files by their times"
            ]
    return []


def _check_one_kind(files: Mapping[str, Collection[str]], pattern: str, key: str) -> None:
    """Refuse frames of which some are images and others what belongs to them: their depth, masks, thumbnails, copies.

    A camera has several names of the same numbers, and one name holds the other (``0001``, ``thumb_0001``, ``1``) or
    differs behind the numbers. Names of one number that differ otherwise (``Image0001`` and ``Depth0001``, ``0001`` and
    ``0001 (1)``), and names without one next to numbered ones (``latest``), may be frames of their own: a warning asks.
    A word of all frames next to the camera may be of another camera's name (``left_rear_0001``).
    """
    fault = "has several kinds of files, such as images and their depth or masks: {} and {}"
    is_joined = re.search(r"\{camera[^/]*\{frame|\{frame[^/]*\{camera", pattern)
    doubt: tuple[str, str] | None = None
    for camera, own in files.items():
        named: dict[tuple[str, ...], str] = {}
        for name in sorted(own, key=lambda name: (len(name), name)):
            numbers = tuple(number.lstrip("0") for number in _NUMBER.findall(name))
            for count in range(1, len(numbers) + 1):
                if (twin := named.get(numbers[:count])) is None:
                    continue
                if count == len(numbers) and (twin in name or _up_to_number(twin) == _up_to_number(name)):
                    raise ArgumentError(f"{key}: {_refusal(pattern, fault.format(twin, name), twin)}")
                doubt = doubt or (twin, name)
            named.setdefault(numbers, name)
        if () in named and len(named) > 1:
            unnumbered = named.pop(())
            doubt = doubt or (min(named.values()), unnumbered)
        words = [set(re.findall(r"(?<![^\W_])[^\W\d_]+(?![^\W_])", name)) for name in own]
        more = sorted(set.intersection(*words)) if words and is_joined else []
        if not is_called("_".join([camera, *more]), camera):
            other = f"takes files of another camera for those of {camera}, if {'_'.join(more)} is a part of its name"
            raise ArgumentError(f"{key}: {_refusal(pattern, other, min(own))}")
    if doubt:
        sentence = _refusal(pattern, fault.format(*doubt), doubt[0])
        warnings.warn(f"{key}: {sentence}, unless all are frames", stacklevel=5)


def _up_to_number(name: str) -> str:
    """A name without what stands behind its last number."""
    return re.sub(r"\D+$", "", name)


def _refusal(pattern: str, fault: str, name: str) -> str:
    """A sentence on a pattern, with one for the files called as a frame where a number is all of what differs."""
    digits = re.sub(r"\d+", lambda number: f"{{frame:0{len(number[0])}d}}", name)
    example = f", such as {pattern.replace('{frame}', digits)!r}" if digits.count("{") == 1 else ""
    return f"{pattern!r} {fault}. Name one in the pattern{example}, or move the others"


def _clocks(files: Mapping[str, Mapping[str, Path]], labels: Mapping[str, str]) -> list[Clock]:
    """The times of images: of counts those in tables next to them, of others those in names where names differ."""
    names = list(set().union(*files.values()))
    if are_counts(names):
        if len(files) == 1:
            return []
        called = {
            camera: {file.name: name for name, file in own.items()} | {str(int(name)): name for name in own}
            for camera, own in files.items()
        }
        folders = {camera: next(iter(own.values())).parent for camera, own in files.items()}
        listed = listed_clock(folders, labels, called)
        return [listed] if listed else []
    if all(len(own) == len(names) for own in files.values()):
        return []
    times = dict(zip(names, seconds(names), strict=True))
    if all(time is None for time in times.values()):
        return []
    timed = {camera: {name: times[name] for name in own} for camera, own in files.items()}
    return [Clock("the times in their names", timed)]


def find_labels(
    pattern: str,
    names: Sequence[str],
    cameras: Sequence[str] | None = None,
    leave_out: Iterable[Path] = (),
    key: str = "images",
) -> dict[str, str]:
    """Find what ``{camera}`` stands for: a camera's name; else a number, as ``labels_by_number`` has it.

    It is decided on the whole rig, so that a camera has the same files whether all cameras are used or some.

    Args:
        pattern: of the files.
        names: cameras of the whole rig, in order.
        cameras: those in use; all when not given.
        leave_out: files that are no images.
        key: that the pattern was given by, for messages.

    Raises:
        ArgumentError: the pattern has no ``{camera}``, or other fields; or several numbers may be meant.
        MissingFileError: there are no files of every camera.
    """
    fields = _fields(pattern, key)
    used = list(names if cameras is None else cameras)
    if not ("camera" in fields or len(used) == 1) or not fields <= {"camera", "frame"}:
        raise ArgumentError(
            f"{key}: expected a pattern with {{camera}} and, if there are several frames, {{frame}}, such as "
            f"{EXAMPLE}, got {pattern!r}"
        )
    excluded = {os.path.realpath(path) for path in leave_out}
    if all(files_of(pattern, name, excluded) for name in used):
        return {name: name for name in used}
    if "camera" not in fields:
        raise MissingFileError(
            f"{key}: no file like {pattern!r} (looked in {Path.cwd()}); correct the pattern"
        )
    numbers = sorted({camera for camera, _ in _matches(pattern, None, excluded)}, key=int)
    labels = labels_by_number(numbers, names, used)
    if labels is None:
        got = f"the numbers {', '.join(numbers)}" if numbers else "no file for it"
        raise MissingFileError(
            f"{key}: {pattern!r} has no files of each of {', '.join(used)} (looked in {Path.cwd()}). {{camera}} stands "
            f"for a camera's name, the number in it, or as many numbers as the rig has cameras; got {got}. Call files "
            "as the cameras, or correct the pattern"
        )
    return labels


def labels_by_number(
    labels: Sequence[str], names: Sequence[str], used: Sequence[str]
) -> dict[str, str] | None:
    """Labels of cameras that are numbers: the last number in a camera's name, or the cameras' order.

    The number in the name counts where every camera has a label of its number, or where no label is of another number;
    the order counts where there are as many labels as cameras, all by the same count from the numbers in their names.

    Args:
        labels: that there are, ``"00"`` or ``"1"``.
        names: cameras of the whole rig, in order.
        used: cameras in use.

    Returns:
        camera name -> label; None where numbers do not tell.

    Examples:
        >>> labels_by_number(["00", "10"], ["cam0", "cam10"], ["cam10"])
        {'cam10': '10'}
        >>> labels_by_number(["0", "1"], ["front", "back"], ["front", "back"])
        {'front': '0', 'back': '1'}
        >>> labels_by_number(["0", "1", "2"], ["front", "back"], ["front"])  # which two?
        >>> labels_by_number(["1", "2"], ["cam1", "cam11"], ["cam1"])  # which is of cam11?
    """
    by_number = {int(label): label for label in labels}
    if len(by_number) != len(labels):  # 1 and 01
        return None
    digits = [re.findall(r"\d+", name) for name in names]
    numbers = {name: int(own[-1]) for name, own in zip(names, digits, strict=True) if own}
    if len(set(numbers.values())) == len(names):
        needed = {numbers[name] for name in used}
        everything = set(numbers.values())
        if everything <= by_number.keys() or needed <= by_number.keys() <= everything:
            return {name: by_number[numbers[name]] for name in used}
        if len({own - label for own, label in zip(numbers.values(), sorted(by_number), strict=False)}) > 1:
            return None
    if len(by_number) != len(names):
        return None
    in_turn = dict(zip(names, sorted(by_number), strict=True))
    return {name: by_number[in_turn[name]] for name in used}


def _fields(pattern: str, key: str = "images") -> set[str]:
    try:
        return {field for _, field, _, _ in string.Formatter().parse(pattern) if field is not None}
    except ValueError as error:
        raise ArgumentError(f"{key}: {pattern!r} is not a pattern ({error})") from None


def files_of(pattern: str, label: str, excluded: Container[str] = ()) -> dict[str, Path]:
    """Frame -> file of one camera; ``""`` is the frame of a pattern without ``{frame}``."""
    files = {}
    matches = _matches(pattern, label, excluded)
    # {frame:03d} is 001 and not 1, unless all numbers have another width.
    exact = {
        key: file for key, file in matches.items() if not key[1] or _frame_text(pattern, key[1]) == key[1]
    }
    for (_, frame), file in (exact or matches).items():
        if re.search("[\0-\x1f\ud800-\udfff]", frame):  # results are listed by name, a line each, in UTF-8
            raise ArgumentError(
                f"images: {str(file)!a}: expected a name in UTF-8 without line ends; rename it"
            )
        files[frame] = file
    return files


def _matches(pattern: str, label: str | None, excluded: Container[str]) -> dict[tuple[str, str], Path]:
    """Label and frame -> file; of one label, or of all that are numbers."""
    glob, expression = "", ""
    for text, field, spec, _ in string.Formatter().parse(str(Path(pattern).expanduser())):
        glob += _escaped(text)
        expression += re.escape(text)
        if field == "camera" and label is not None:
            glob += _escaped(label)
            expression += re.escape(label)
        elif field is not None:
            digits = field == "camera" or (spec or "").endswith("d")
            glob += "*"
            repeated = f"(?P<{field}>" in expression
            expression += f"(?P={field})" if repeated else f"(?P<{field}>{'[0-9]+' if digits else '[^/]+'})"
    path = Path(glob)
    anchor = Path(path.anchor) if path.is_absolute() else Path()
    is_hidden_pattern = Path(pattern).name.startswith(".")
    matches = {}
    for file in anchor.glob(str(path.relative_to(path.anchor) if path.is_absolute() else path)):
        match = re.fullmatch(expression, str(file))
        is_hidden = file.name.startswith(".") and not is_hidden_pattern  # ._0001.png of macOS
        # A link to nothing, as of files that were not fetched, is a frame that cannot be read.
        is_file = file.is_file() or not file.exists()
        if match and not is_hidden and is_file and os.path.realpath(file) not in excluded:
            values = match.groupdict()
            matches[values.get("camera", ""), values.get("frame") or ""] = file
    return matches


def _escaped(text: str) -> str:
    return re.sub(r"([*?\[])", r"[\1]", text)


def _frame_text(pattern: str, frame: int | str) -> str:
    """A frame as it stands in file names."""
    for _, field, spec, _ in string.Formatter().parse(pattern):
        if field == "frame":
            try:
                return format(int(frame) if spec and spec.endswith("d") else frame, spec or "")
            except ValueError:
                raise ArgumentError(f"frames: expected numbers, as {pattern!r} says, got {frame!r}") from None
    raise ArgumentError(f"frames: {pattern!r} has no {{frame}} to put {frame!r} in")
