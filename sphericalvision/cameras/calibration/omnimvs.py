# SPDX-License-Identifier: Apache-2.0
"""``config.yaml`` of the OmniMVS family: OCam cameras with poses in metres and fields of view in degrees.

Convention:
    ``pose`` is axis-angle in radians and translation in metres, camera to rig; ``center`` is (row, column);
    ``max_fov`` is the full angle. A mask is white where a pixel must **not** be used.
"""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Any

from sphericalvision.cameras.calibration.contents import Calibration
from sphericalvision.cameras.calibration.formats import FileFormat
from sphericalvision.cameras.calibration.keys import Keys
from sphericalvision.cameras.calibration.lenses import check_targets
from sphericalvision.cameras.calibration.ocam_text import counted, make_ocam, ocam_numbers
from sphericalvision.cameras.calibration.parsing import size_from_width_height
from sphericalvision.cameras.calibration.poses import axis_angle_from_rotation, transform_from_rotation_vector
from sphericalvision.cameras.models.ocam import OCamCamera
from sphericalvision.cameras.rig import CameraRig
from sphericalvision.io.images import read_mask, write_mask
from sphericalvision.io.yaml_files import write_yaml


def recognizes(content: dict[str, Any]) -> bool:
    """Whether a parsed file has a list of cameras, with keys of OCam or of this family."""
    cameras = content.get("cameras")
    return isinstance(cameras, list) and any(
        isinstance(values, dict)
        and len({"cam_id", "poly", "inv_poly", "affine", "max_fov"} & set(values)) > 1
        for values in cameras
    )


def read(content: Keys, calibration: Calibration) -> None:
    """Cameras and poses of a parsed ``config.yaml``; cameras are named ``cam<cam_id>``.

    ``invalid_mask`` images, white where a pixel must not be used, are read where they exist; they are seldom shipped.
    """
    for values in content.several("cameras"):
        name = f"cam{values.entry('cam_id')}"
        values.where += f" ({name:.80})"
        camera, view = _camera(values), values.half_view("max_fov")
        pose = values.numbers("pose", 6)
        world_from_camera = transform_from_rotation_vector(pose[:3], pose[3:], values.at("pose"))
        calibration.add(name, camera, values.where, world_from_camera, view)
        mask = values.get("invalid_mask")
        if mask and (calibration.path.parent / str(mask)).is_file():
            calibration.masks[name] = read_mask(
                calibration.path.parent / str(mask), camera.image_size, usable="black"
            )


def _camera(values: Keys) -> OCamCamera:
    values.chosen("model", ("ocam",), default="ocam")
    where = values.where
    direct, inverse = values.numbers("poly"), values.get("inv_poly")
    inverse = counted(values.numbers("inv_poly"), f"{where}, inverse polynomial") if inverse else None
    center, affine = values.numbers("center", 2), values.numbers("affine", 3)
    size = size_from_width_height(values.numbers("image_size", 2)[::-1], f"{where}, image size")
    return make_ocam(
        counted(direct, f"{where}, direct polynomial"), inverse, center[::-1], affine, size, where
    )


def write_omnimvs(rig: CameraRig, path: str | Path) -> None:
    """Write a rig of ``OCamCamera`` as ``config.yaml``, and masks as ``mask<cam_id>.png`` beside it.

    ``cam7`` gets the ``cam_id`` 7; with other names cameras are numbered from 1.
    """
    path = Path(path)
    numbered = all(re.fullmatch(r"cam\d+", name) for name in rig.names)
    ids = [int(name[3:]) if numbered else place for place, name in enumerate(rig.names, start=1)]
    masks = {name: path.with_name(f"mask{cam_id}.png") for cam_id, name in zip(ids, rig.names, strict=True)}
    check_targets(path, masks, rig)
    entries = []
    for cam_id, pose, camera in zip(ids, rig.world_from_camera, rig.cameras.values(), strict=True):
        entries.append(
            {
                "cam_id": cam_id,
                "img_dir": f"cam{cam_id}",
                "model": "ocam",
                **ocam_numbers(camera, "omnimvs"),
                "invalid_mask": f"mask{cam_id}.png",  # OmniMVS asks for it in any case
                "pose": [*axis_angle_from_rotation(pose[:3, :3]), *pose[:3, 3].tolist()],
                "max_fov": math.degrees(2 * float(camera.max_angle)),
            }
        )
    for name, mask in rig.masks.items():
        write_mask(masks[name], ~mask)
    write_yaml(path, {"cameras": entries})


FileFormat(
    "omnimvs",
    "OmniMVS config.yaml",
    recognizes_keys=recognizes,
    read_keys=read,
    ignored="config|dataset|cameras/img_dir",
    usual_names=("config.yaml",),
    models=("ocam",),
    write_rig=write_omnimvs,
    holds_masks=True,
).register()
