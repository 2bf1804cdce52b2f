from .kinds.labels import SURFACE_LABELS as SURFACE_LABELS
from .procedural import (
    Scene as Scene,
)
from .procedural import (
    make_scene as make_scene,
)
from .rendering.mesh_scene import MeshScene as MeshScene
from .rendering.mesh_scene import read_mesh_scene as read_mesh_scene
from .rendering.render import ray_depth as ray_depth
from .rendering.render import ray_labels as ray_labels
from .rendering.render import render_camera as render_camera
from .rendering.render import render_directions as render_directions
from .rendering.render import render_rig as render_rig
from .samples import WorldSamples as WorldSamples
from .world import World as World
