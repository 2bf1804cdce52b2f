# SPDX-License-Identifier: Apache-2.0
"""What a function is told it hands on: a value keeps its name on its way from the command line to who works with it."""

from __future__ import annotations

import ast
import dataclasses
import inspect
import re
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

from typing_extensions import is_typeddict

import sphericalvision.recipes
from sphericalvision.scenes import World

FOLDER = Path(sphericalvision.recipes.__file__).parent
OTHERWISE = """
__getitem__/self._reason/index __init__/_two_see/rig _images/models.Remap/device _meshes/mesh_files/scale
_open_single/CameraRig/masks _open_single/open_source/cameras _open_single/open_source/tolerance
_projection/icosphere_vertices/device _rendered_scenes/SampleView/images _scene_median/make_scene/scale
check_node/check_node/passed chosen_tracks/Track/meshes data/make_scene/device demo/build/config
demo/evaluate/folder demo/Predictor/device evaluate_checkpoint/evaluate/folder evaluate_checkpoint/Method/seed
fps/make_scene/device gpu/make_scene/device gpu/Predictor/device inspect/CameraRig/masks
make_panorama_ring/ring_rig/image_size make_rig/make_corner_rig/tilt_deg make_rig/random_rig/num_cameras
make_rig/random_rig/radius render/build/config training_depths/SampleView/level
"""
"""Function/what it calls/an argument of that, which is not the caller's of this name: it has one of its own."""


def evaluated(node: ast.expr | None, scope: dict[str, Any]) -> Any:
    """The value of an expression of names that a module has; None of any other, and of what calls something."""
    text = ast.unparse(node) if node is not None else "None"
    try:
        return None if "(" in text.removeprefix("super()") else eval(text, scope)
    except Exception:  # of what is local
        return None


def values_of(function: ast.FunctionDef, owner: Any, scope: dict[str, Any]) -> dict[str, str]:
    """Name -> how it is written: arguments, keys of the configurations among them, and fields of a dataclass' own."""
    arguments = [*function.args.posonlyargs, *function.args.args, *function.args.kwonlyargs]
    values = {}
    if dataclasses.is_dataclass(owner):
        values = {field.name: f"self.{field.name}" for field in dataclasses.fields(owner)}
    for argument in arguments:
        hint = evaluated(argument.annotation, scope)
        for kind in (hint, *getattr(hint, "__metadata__", ())):
            keys = kind.__annotations__ if is_typeddict(kind) else getattr(kind, "_fields", ())
            keys = getattr(kind, "__dataclass_fields__", keys)
            values |= {re.sub("_(deg|m)$", "", key): f"{argument.arg}.{key}" for key in keys}
    return values | {argument.arg: argument.arg for argument in arguments}


def not_handed_on(tree: ast.Module, scope: dict[str, Any]) -> Iterator[str]:
    """Arguments of calls in a module that have a caller's name and another of its values, a constant, or none."""
    owners = {
        part: scope.get(c.name) for c in ast.walk(tree) if isinstance(c, ast.ClassDef) for part in c.body
    }
    for function in (node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)):
        owner = owners.get(function)
        own = {**scope, "self": owner, "super": lambda owner=owner: super(owner, owner)}
        values = values_of(function, owner, own)
        exchanged = {*values.values(), "[]", "()"}
        for call in (node for node in ast.walk(function) if isinstance(node, ast.Call)):
            called = evaluated(call.func, own)
            if not str(getattr(called, "__module__", "")).startswith("sphericalvision"):
                continue
            if isinstance(called, type) and issubclass(called, Exception):
                continue
            starred = [isinstance(value, ast.Starred) for value in call.args]
            if any(starred) or None in [word.arg for word in call.keywords]:
                continue  # of which it is not written what they are
            words = {str(word.arg): word.value for word in call.keywords}
            signature = inspect.signature(called)
            first = [None] * ("self" in signature.parameters)
            given = signature.bind_partial(*first, *call.args, **words).arguments
            single = {p.name for p in signature.parameters.values() if not str(p).startswith("*")}
            for name in values.keys() & single - {"self"}:
                value = given.get(name, ast.Constant(None))
                if isinstance(value, ast.Constant) or ast.unparse(value) in exchanged - {values[name]}:
                    yield f"{function.name}/{ast.unparse(call.func)}/{name}"


def test_values_are_handed_on_by_their_names() -> None:
    differing = set()
    for path in FOLDER.rglob("*.py"):
        if path.stem not in ("__init__", "__main__"):
            name = ".".join(path.relative_to(FOLDER).with_suffix("").parts)
            scope = vars(import_module(f"sphericalvision.recipes.{name}"))
            differing |= {*not_handed_on(ast.parse(path.read_text()), scope)}
    assert differing == {*OTHERWISE.split()}


def test_what_is_dropped_or_exchanged_is_found() -> None:
    code = """def made(rig, kind, min_depth):
        World(rig, kind), World(rig, min_depth, kind), World(rig, kind, 0.5), World(rig, kind, min_depth)"""
    differing = [*not_handed_on(ast.parse(code), {"World": World})]
    assert sorted(differing) == [
        f"made/World/{name}" for name in ("kind", "min_depth", "min_depth", "min_depth")
    ]
