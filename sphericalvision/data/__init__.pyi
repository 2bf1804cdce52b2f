import typing

from .augmentation.fivefold import RotateFivefold as RotateFivefold
from .augmentation.photometric import PhotometricAugmentation as PhotometricAugmentation
from .augmentation.rotate_fisheye import RotateFisheye as RotateFisheye
from .augmentation.sphere_rotation import random_rotations as random_rotations
from .augmentation.sphere_transforms import RandomSphereRotation as RandomSphereRotation
from .augmentation.sphere_transforms import RandomYaw as RandomYaw
from .augmentation.transforms import Compose as Compose
from .augmentation.transforms import RandomShift as RandomShift
from .augmentation.transforms import ShuffleCameras as ShuffleCameras
from .augmentation.transforms import ToSphere as ToSphere
from .collate import collate_samples as collate_samples
from .omnistereo.dataset import OmniStereoDataset as OmniStereoDataset
from .omnistereo.writer import write_omnistereo as write_omnistereo
from .point_files import read_points as read_points
from .truth import truth_from_points as truth_from_points

def __getattr__(name: str) -> typing.Any: ...
