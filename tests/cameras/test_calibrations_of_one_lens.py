# SPDX-License-Identifier: Apache-2.0
"""TUM-VI's two lenses, calibrated three times: as Kannala-Brandt by Kalibr, as double sphere and EUCM by Basalt.

Each calibration is a measurement of the same lenses, so files of two formats and three models must agree to within what
calibrations differ by. The numbers are those of the published files.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from sphericalvision.cameras import CameraRig, read_rig
from tests.cameras.calibration_samples import directions, dump

KB4 = {
    "intrinsics": [
        [190.97847715128717, 190.9733070521226, 254.93170605935475, 256.8974428996504],
        [190.44236969414825, 190.4344384721956, 252.59949716835982, 254.91723064636983],
    ],
    "distortion": [
        [0.0034823894022493434, 0.0007150348452162257, -0.0020532361418706202, 0.00020293673591811182],
        [0.0034003170790442797, 0.001766278153469831, -0.00266312569781606, 0.0003299517423931039],
    ],
    "camera_from_imu": [
        [
            [-0.9995250378696743, 0.029615343885863205, -0.008522328211654736, 0.04727988224914392],
            [0.0075019185074052044, -0.03439736061393144, -0.9993800792498829, -0.047443232143367084],
            [-0.02989013031643309, -0.998969345370175, 0.03415885127385616, -0.0681999605066297],
            [0.0, 0.0, 0.0, 1.0],
        ],
        [
            [-0.9995110484978581, 0.030299116376600627, -0.0077218830287333565, -0.053697434688869734],
            [0.008104079263822521, 0.012511643720192351, -0.9998888851620987, -0.046131737923635924],
            [-0.030199136245891378, -0.9994625667418545, -0.012751072573940885, -0.07149261284195751],
            [0.0, 0.0, 0.0, 1.0],
        ],
    ],
}
DS = [
    [158.28600034966977, 158.2743455478755, 254.96116578191653, 256.8894394501779, -0.17213086034353243,
     0.5931177593944744],
    [157.91830144176309, 157.8901286125632, 252.56547609702953, 255.02489416194656, -0.17114780716007858,
     0.5925543396658507],
]  # fmt: skip
EUCM = [
    [191.14799836282189, 191.13150963902818, 254.9585771534443, 256.88154645599448, 0.6291060881178562,
     1.0418067381860868],
    [190.47905769226575, 190.44567561523216, 252.55882115024333, 255.02104780344699, 0.6281040684983363,
     1.041250259119081],
]  # fmt: skip
IMU_FROM_CAMERA = [  # px py pz qx qy qz qw
    [0.04548094812071685, -0.07145370002838907, -0.046315428444919249, -0.013392900690257393, -0.6945866755293793,
     0.7192437840259219, 0.007639340823570553],
    [-0.05546984222234079, -0.06999334244486549, -0.049092582974927929, -0.01340980138125811, -0.7115668842588793,
     0.7024477338114514, 0.007741299385907546],
]  # fmt: skip


def kalibr_file() -> dict[str, Any]:
    return {
        f"cam{index}": {
            "T_cam_imu": KB4["camera_from_imu"][index],
            "camera_model": "pinhole",
            "distortion_model": "equidistant",
            "distortion_coeffs": KB4["distortion"][index],
            "intrinsics": KB4["intrinsics"][index],
            "resolution": [512, 512],
        }
        for index in (0, 1)
    }


def basalt_file(kind: str) -> dict[str, Any]:
    more = ("xi", "alpha") if kind == "ds" else ("alpha", "beta")
    keys = ("fx", "fy", "cx", "cy", *more)
    pose = ("px", "py", "pz", "qx", "qy", "qz", "qw")
    lenses = DS if kind == "ds" else EUCM
    return {
        "value0": {
            "T_imu_cam": [dict(zip(pose, values, strict=True)) for values in IMU_FROM_CAMERA],
            "intrinsics": [
                {"camera_type": kind, "intrinsics": dict(zip(keys, values, strict=True))} for values in lenses
            ],
            "resolution": [[512, 512], [512, 512]],
        }
    }


@pytest.fixture
def rigs(tmp_path: Path) -> list[CameraRig]:
    """Kannala-Brandt, double sphere, EUCM."""
    files = {"camchain.yaml": kalibr_file(), "ds.json": basalt_file("ds"), "eucm.json": basalt_file("eucm")}
    return [read_rig(dump(tmp_path / name, content), dtype=torch.float64) for name, content in files.items()]


RAYS = directions(97.0, rings=98, spokes=72)


@pytest.mark.parametrize("index", [0, 1])
def test_three_models_of_one_lens_agree_to_97_degrees(rigs: list[CameraRig], index: int) -> None:
    """0.798 and 0.705 px between KB4 and DS, 0.144 and 0.141 px between DS and EUCM."""
    kb4, ds, eucm = (
        rig.cameras[f"cam{index}"].project(torch.from_numpy(RAYS)).pixels.numpy() for rig in rigs
    )
    assert np.linalg.norm(kb4 - ds, axis=-1).max() < 0.80
    assert np.linalg.norm(ds - eucm, axis=-1).max() < 0.15


def test_extrinsics_of_both_programs_agree(rigs: list[CameraRig]) -> None:
    """Kalibr's file takes the IMU to the camera, Basalt's the camera to the IMU: 0.034° and 1.8 mm apart."""
    kalibr, basalt, _ = (rig.world_from_camera.numpy() for rig in rigs)
    for one, other in zip(kalibr, basalt, strict=True):
        cosine = (np.trace(one[:3, :3].T @ other[:3, :3]) - 1) / 2
        assert np.degrees(np.arccos(min(cosine, 1.0))) < 0.05
        assert np.linalg.norm(one[:3, 3] - other[:3, 3]) < 0.002
