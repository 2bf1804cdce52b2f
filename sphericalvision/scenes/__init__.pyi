from .kinds.labels import SURFACE_LABELS as SURFACE_LABELS
from .recipes import (
    Scene as Scene,
)
from .recipes import (
    make_scene as make_scene,
)
from .recipes import (
    ray_depth as ray_depth,
)
from .recipes import (
    render_camera as render_camera,
)
from .recipes import (
    render_directions as render_directions,
)
from .recipes import (
    render_rig as render_rig,
)
from .rendering.mesh_scene import MeshScene as MeshScene
from .rendering.mesh_scene import read_mesh_scene as read_mesh_scene
from .rendering.render import ray_labels as ray_labels
from .samples import WorldSamples as WorldSamples
from .world import World as World
