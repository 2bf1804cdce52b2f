from .basalt import write_basalt as write_basalt
from .colmap import write_colmap as write_colmap
from .colmap import write_colmap_rig as write_colmap_rig
from .detect import read_camera as read_camera
from .detect import read_cameras as read_cameras
from .detect import read_rig as read_rig
from .kalibr import write_kalibr as write_kalibr
from .native import write_camera as write_camera
from .native import write_rig as write_rig
from .ocam_text import read_ocam_text as read_ocam_text
from .ocam_text import write_ocam_text as write_ocam_text
from .omnimvs import write_omnimvs as write_omnimvs
from .opencv_writer import write_opencv as write_opencv
from .save import save_camera as save_camera
from .save import save_rig as save_rig
from .trajectories import read_trajectory as read_trajectory

CAMERA_FORMATS: tuple[str, ...]
RIG_FORMATS: tuple[str, ...]
