from . import cameras as cameras
from . import capture as capture
from . import core as core
from . import crown as crown
from . import data as data
from . import geometry as geometry
from . import icosphere as icosphere
from . import io as io
from . import kernels as kernels
from . import losses as losses
from . import metrics as metrics
from . import models as models
from . import scenes as scenes
from . import sphere as sphere
from . import sweep as sweep
from . import viz as viz
from .capture import Predictor as Predictor

__version__: str
