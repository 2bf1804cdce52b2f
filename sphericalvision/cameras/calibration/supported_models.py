# SPDX-License-Identifier: Apache-2.0
"""Which camera models each file format can hold, and the error when it cannot hold one."""

from __future__ import annotations

from collections.abc import Iterable

from jaxtyping import Shaped
from torch import Tensor

from sphericalvision.cameras.base import Camera, check_single
from sphericalvision.cameras.calibration.formats import file_format, file_formats
from sphericalvision.core import ArgumentError

__all__ = ["check_holds", "numbers_of", "without_trailing_zeros"]


_WITH_SKEW = ("native", "opencv")
_WITHOUT_SKEW_IN_OPENCV = ("pinhole", "brown_conrady")  # whose functions take no notice of it


def check_holds(format: str, camera: Camera) -> None:
    """Raise ``ArgumentError`` unless ``format`` has the camera's model and the camera is no batch."""
    check_single(camera)
    models = file_format(format).models
    if models and camera.model not in models:
        others = [
            known.name
            for known in file_formats()
            if (known.write_camera or known.write_rig) and (not known.models or camera.model in known.models)
        ]
        raise ArgumentError(
            f"camera: the format {format!r} has no {camera.model} model, it has {', '.join(models)}. Write it as "
            f"{' or '.join(map(repr, others))}, or convert the camera first: camera.convert(to=...)"
        )
    formats = _WITH_SKEW[:1] if camera.model in _WITHOUT_SKEW_IN_OPENCV else _WITH_SKEW
    if format not in formats and getattr(camera, "skew", None) is not None:
        raise ArgumentError(
            f"camera: the format {format!r} has no skew; write it as {' or '.join(map(repr, formats))}, or convert "
            'the camera to OCam, whose affine map holds one: camera.convert(to="ocam")'
        )


def numbers_of(tensor: Shaped[Tensor, " ..."]) -> list[float]:
    """Plain float64 numbers of a parameter, whatever its device and whether it is learned."""
    values: list[float] = tensor.detach().to("cpu").double().flatten().tolist()
    return values


def without_trailing_zeros(values: Iterable[float], lengths: tuple[int, ...], what: str) -> list[float]:
    """``values`` cut or filled with zeros to the first of ``lengths`` that loses none of them.

    Raises:
        ArgumentError: there are more numbers that are not zero than the longest of ``lengths`` holds.

    Examples:
        >>> without_trailing_zeros([0.1, 0.0, 0.0, 0.0, 0.0], (4, 8), "distortion")
        [0.1, 0.0, 0.0, 0.0]
    """
    given = list(values)
    for length in lengths:
        if not any(given[length:]):
            return (given + [0.0] * length)[:length]
    raise ArgumentError(
        f"camera: this format holds {lengths[-1]} numbers of {what}, got {given}; write it as 'native', or convert "
        "the camera first: camera.convert(to=...)"
    )
