from .alignment import align_rig as align_rig
from .calibrating.boards import AprilGrid as AprilGrid
from .calibrating.boards import Charuco as Charuco
from .calibrating.boards import Checkerboard as Checkerboard
from .calibrating.boards import read_board as read_board
from .calibrating.calibrate import calibrate_camera as calibrate_camera
from .calibrating.calibrate import calibrate_rig as calibrate_rig
from .calibrating.direct_alignment import align_rig_direct as align_rig_direct
from .calibrating.refine import refine as refine
from .calibrating.refine import refine_rig as refine_rig
from .hints import Hint as Hint
from .predictor import Predictor as Predictor
from .preparation.own_body import OwnBody as OwnBody
from .preparation.own_body import find_own_body as find_own_body
from .preparation.photometry import (
    PhotometricCalibration as PhotometricCalibration,
)
from .preparation.photometry import (
    calibrate_photometry as calibrate_photometry,
)
from .preparation.preparation import Preparation as Preparation
from .result import Depth as Depth
from .result import DepthImage as DepthImage
