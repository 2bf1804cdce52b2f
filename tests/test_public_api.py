# SPDX-License-Identifier: Apache-2.0
"""The public names, checked against a list that is kept in the repository.

`tests/public_api.txt` is that list: one `module: name` a line. A name that appears or disappears is a decision, so
the list is changed by hand or with `python tests/test_public_api.py > tests/public_api.txt` and read in review.
"""

from __future__ import annotations

import doctest
import importlib
import inspect
from pathlib import Path

import pytest

INVENTORY = Path(__file__).with_name("public_api.txt")

PACKAGES = (
    "sphericalvision.cameras",
    "sphericalvision.capture",
    "sphericalvision.core",
    "sphericalvision.crown",
    "sphericalvision.data",
    "sphericalvision.geometry",
    "sphericalvision.icosphere",
    "sphericalvision.kernels",
    "sphericalvision.losses",
    "sphericalvision.metrics",
    "sphericalvision.models",
    "sphericalvision.scenes",
    "sphericalvision.sphere",
    "sphericalvision.sweep",
    "sphericalvision.viz",
)

# Names, and the arguments they are called with, that code outside this repository relies on.
SIGNATURES = {
    "sphericalvision.cameras.Camera.project": "points",
    "sphericalvision.cameras.Camera.unproject": "pixels",
    "sphericalvision.cameras.Camera.sample": "image points",
    "sphericalvision.cameras.FisheyeCamera": "projection focal_length principal_point image_size max_angle",
    "sphericalvision.cameras.OCamCamera": "polynomial inverse_polynomial principal_point affine image_size max_angle",
    "sphericalvision.cameras.FisheyeCamera.from_field_of_view": "image_size field_of_view projection",
    "sphericalvision.cameras.EquirectangularCamera": "image_size",
    "sphericalvision.cameras.DoubleSphereCamera": "focal_length principal_point xi alpha image_size max_angle",
    "sphericalvision.cameras.KannalaBrandtCamera": "focal_length principal_point distortion image_size max_angle",
    "sphericalvision.cameras.BrownConradyCamera": "focal_length principal_point distortion image_size max_angle",
    "sphericalvision.cameras.UnifiedCamera": "focal_length principal_point xi distortion image_size max_angle",
    "sphericalvision.cameras.ExtendedUnifiedCamera": "focal_length principal_point alpha beta image_size max_angle",
    "sphericalvision.cameras.RadialPolynomialCamera": "polynomial principal_point aspect_ratio image_size max_angle",
    "sphericalvision.cameras.CameraRig": "cameras world_from_camera masks",
    "sphericalvision.cameras.read_rig": "path translation_unit max_angle",
    "sphericalvision.icosphere.Icosphere": "level dtype device",
    "sphericalvision.icosphere.Icosphere.locate": "directions",
    "sphericalvision.icosphere.Icosphere.sample": "values directions",
    "sphericalvision.sphere.Equirectangular": "height width",
    "sphericalvision.sphere.Cubemap": "size",
    "sphericalvision.sphere.Healpix": "nside nested",
    "sphericalvision.sphere.TangentImages": "base_level size",
    "sphericalvision.sphere.Resample": "source target rotation mode",
    "sphericalvision.sphere.resample": "values source target rotation mode",
    "sphericalvision.crown.to_crown": "values",
    "sphericalvision.crown.from_crown": "crown",
    "sphericalvision.crown.CrownConv2d": "in_channels out_channels stride",
    "sphericalvision.crown.CrownConv3d": "in_channels out_channels stride",
    "sphericalvision.sweep.inverse_depth_hypotheses": "num_hypotheses min_depth",
    "sphericalvision.sweep.SphereSweep": "level num_hypotheses min_depth",
    "sphericalvision.sweep.depth_from_index": "index num_hypotheses min_depth",
    "sphericalvision.sweep.index_from_depth": "depth num_hypotheses min_depth",
    "sphericalvision.sweep.soft_argmax": "logits",
    "sphericalvision.models.IcoSweepNet": "level num_hypotheses min_depth feature_channels num_cameras",
    "sphericalvision.models.weights.save_weights": "net path",
    "sphericalvision.models.weights.load_weights": "path",
    "sphericalvision.models.weights.load_reference_checkpoint": "path",
    "sphericalvision.models.weights.pretrained": "name",
    "sphericalvision.Predictor": "rig weights method min_depth",
    "sphericalvision.metrics.DepthIndexError": "num_hypotheses",
    "sphericalvision.metrics.DepthIndexError.update": "pred target mask weights",
    "sphericalvision.metrics.DepthError": "",
    "sphericalvision.losses.depth_index_huber": "pred_index target_index mask delta",
    "sphericalvision.data.OmniStereoDataset": "root frames split protocol dataset release transform",
    "sphericalvision.data.collate_samples": "samples",
    "sphericalvision.scenes.make_scene": "kind seed device",
    "sphericalvision.data.write_omnistereo": "root frames rig release",
}


def public_names() -> list[str]:
    """What every public package offers now, as lines of the inventory."""
    found = []
    for package in PACKAGES:
        module = importlib.import_module(package)
        found += [
            f"{package}: {name}" for name in module.__all__ if not inspect.ismodule(getattr(module, name))
        ]
    return sorted(found)


def resolve(dotted: str) -> object:
    """The object a dotted name stands for; a name that a package exports wins over its module of that name."""
    first, *rest = dotted.split(".")
    found: object = importlib.import_module(first)
    path = first
    for name in rest:
        path = f"{path}.{name}"
        found = getattr(found, name) if hasattr(found, name) else importlib.import_module(path)
    return found


def test_public_names_are_the_inventory() -> None:
    expected = INVENTORY.read_text().splitlines()
    now = public_names()
    appeared, gone = sorted(set(now) - set(expected)), sorted(set(expected) - set(now))
    assert now == expected, (
        f"new: {appeared}; gone: {gone}; if meant, update {INVENTORY.name} (see the top of this file)"
    )


@pytest.mark.parametrize("package", PACKAGES)
def test_every_public_name_exists_and_says_what_it_is(package: str) -> None:
    module = importlib.import_module(package)
    for name in module.__all__:
        found = getattr(module, name)
        if inspect.isclass(found) or inspect.isfunction(found):
            assert inspect.getdoc(found), f"{package}.{name} has no docstring"


NO_EXAMPLE: dict[str, str] = {}
"""Names without an example, and why; empty is best."""


def test_every_public_name_has_an_example_that_prints() -> None:
    """Classes and functions show what they return; ``tests/test_doctests.py`` runs the examples."""
    parser, silent = doctest.DocTestParser(), []
    for line in public_names():
        package, name = line.split(": ")
        found = getattr(importlib.import_module(package), name)
        if not (inspect.isclass(found) or inspect.isfunction(found)):
            continue
        if not any(example.want for example in parser.get_examples(found.__doc__ or "")):
            silent.append(f"{package}.{name}")
    assert silent == sorted(NO_EXAMPLE), "give each an example in its docstring, or a reason in NO_EXAMPLE"


@pytest.mark.parametrize("dotted", sorted(SIGNATURES))
def test_signature(dotted: str) -> None:
    """The promised arguments exist, under their names and in their order."""
    parameters = [name for name in inspect.signature(resolve(dotted)).parameters if name != "self"]  # type: ignore[arg-type]
    promised = SIGNATURES[dotted].split()
    assert [name for name in parameters if name in promised] == promised


if __name__ == "__main__":
    print("\n".join(public_names()))
