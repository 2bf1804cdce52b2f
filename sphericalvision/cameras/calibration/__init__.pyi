from .colmap import write_colmap as write_colmap
from .detect import read_camera as read_camera
from .detect import read_cameras as read_cameras
from .detect import read_rig as read_rig
from .save import save_camera as save_camera
from .save import save_rig as save_rig
from .trajectories import read_trajectory as read_trajectory

CAMERA_FORMATS: tuple[str, ...]
RIG_FORMATS: tuple[str, ...]
