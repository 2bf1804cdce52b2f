from .kinds.labels import SURFACE_LABELS as SURFACE_LABELS
from .procedural import (
    Scene as Scene,
)
from .procedural import (
    make_scene as make_scene,
)
from .procedural import (
    ray_depth as ray_depth,
)
from .procedural import (
    render_camera as render_camera,
)
from .procedural import (
    render_directions as render_directions,
)
from .procedural import (
    render_rig as render_rig,
)
from .rendering.mesh_scene import MeshScene as MeshScene
from .rendering.mesh_scene import read_mesh_scene as read_mesh_scene
from .rendering.render import ray_labels as ray_labels
from .samples import WorldSamples as WorldSamples
from .world import World as World
