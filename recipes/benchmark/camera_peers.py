# SPDX-License-Identifier: Apache-2.0
"""Other libraries doing what the cameras of the benchmark do: kornia and OpenCV, and those that happen to be installed.

ds-msp and py360convert are no dependencies: without them their rows are left out, and the note under the table says so.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from importlib import import_module
from importlib.util import find_spec
from typing import Any

import cv2
import numpy as np
import torch
from kornia.geometry.camera import distortion_kannala_brandt as kornia_kannala_brandt
from torch import Tensor

__all__ = ["Peers", "perspective_peers"]

Runs = dict[str, Callable[[], Any]]


class Peers:
    """The same lens in other libraries.

    Args:
        focal_length: of u and v in pixels.
        principal_point: (u, v).
        kannala_brandt: four coefficients.
        brown_conrady: OpenCV's coefficients.
        double_sphere: (ξ, α).
    """

    def __init__(
        self,
        focal_length: Sequence[float],
        principal_point: Sequence[float],
        kannala_brandt: Sequence[float],
        brown_conrady: Sequence[float],
        double_sphere: Sequence[float],
    ) -> None:
        self.pinhole = [*focal_length, *principal_point]
        (fx, fy), (cx, cy) = focal_length, principal_point
        self.matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
        self.kannala_brandt, self.brown_conrady = np.array(kannala_brandt), np.array(brown_conrady)
        self.ds_msp = {
            "Kannala-Brandt": ("KannalaBrandtModel", [*self.pinhole, *kannala_brandt]),
            "double sphere": ("DoubleSphereModel", [*self.pinhole, *double_sphere]),
        }
        self.zero = np.zeros(3)

    def runs(self, name: str, verb: str, values: Tensor) -> tuple[Runs, str]:
        """Functions that ``verb`` ("project" or "unproject") ``values``, and what to know about them."""
        runs, note = self._kornia_and_opencv(name, verb, values)
        if name in self.ds_msp and values.dtype == torch.float64:
            if find_spec("ds_msp"):
                kind, parameters = self.ds_msp[name]
                peer = getattr(import_module("ds_msp.models"), kind)(*parameters)
                runs["ds-msp"] = partial(getattr(peer, verb), values.cpu().numpy())
            else:
                note += " ds-msp is not installed."
        return runs, note.strip()

    def _kornia_and_opencv(self, name: str, verb: str, values: Tensor) -> tuple[Runs, str]:
        array = values.cpu().numpy()[:, None]
        if name == "Kannala-Brandt" and verb == "unproject":
            parameters = torch.tensor([*self.pinhole, *self.kannala_brandt]).to(values)
            return {
                "kornia": partial(kornia_kannala_brandt.undistort_points_kannala_brandt, values, parameters),
                "OpenCV": partial(cv2.fisheye.undistortPoints, array, self.matrix, self.kannala_brandt),
            }, "kornia and OpenCV answer on the plane z = 1, so not beyond 90°."
        if name == "Kannala-Brandt":
            parameters = torch.tensor([*self.pinhole, *self.kannala_brandt]).to(values)
            plane = values[..., :2] / values[..., 2:]
            arguments = array, self.zero, self.zero, self.matrix, self.kannala_brandt
            return {
                "kornia": partial(kornia_kannala_brandt.distort_points_kannala_brandt, plane, parameters),
                "OpenCV": partial(cv2.fisheye.projectPoints, *arguments),
            }, "kornia takes points of the plane z = 1."
        if name.startswith("Brown-Conrady"):
            if verb == "project":
                arguments = array, self.zero, self.zero, self.matrix, self.brown_conrady
                return {"OpenCV": partial(cv2.projectPoints, *arguments)}, ""
            opencv = partial(cv2.undistortPoints, array, self.matrix, self.brown_conrady)
            return {"OpenCV": opencv}, "OpenCV takes five rounds of fixed-point iteration, whatever is left."
        return {}, ""


def perspective_peers(panorama: Tensor, field_of_view_deg: float, size: tuple[int, int]) -> tuple[Runs, str]:
    """py360convert's view out of a panorama (3, h, w)."""
    if not find_spec("py360convert"):
        return {}, "py360convert is not installed."
    array = panorama.movedim(0, -1).contiguous().cpu().numpy()
    view = import_module("py360convert").e2p
    return {"py360convert": lambda: view(array, (field_of_view_deg, field_of_view_deg), 0, 0, size)}, (
        "py360convert makes its table anew in every call; Remap keeps it."
    )
