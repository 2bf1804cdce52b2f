# SPDX-License-Identifier: Apache-2.0
"""Augmentation by rotation: values on the sphere, and the rig that saw them, rotated together.

The modules follow Kornia's: what is drawn at random is a dictionary of tensors, made by ``forward_parameters`` and kept
in ``_params``; given back as ``params`` it does the same again, to other data if wanted, and ``inverse`` undoes it;
``p`` and ``same_on_batch`` mean what they mean there.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Mapping
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from sphericalvision.cameras import CameraRig
from sphericalvision.core import ArgumentError, ShapeError, check_choice
from sphericalvision.data.augmentation.sphere_rotation import (
    CONTENTS,
    num_yaw_steps,
    random_rotations,
    rotate_on_sphere,
    yaw_angle,
    yaw_on_sphere,
    yaw_rotation,
)
from sphericalvision.sphere import SphereGrid

USUAL_KINDS = {
    "image": "image",
    "images": "image",
    "depth": "depth",
    "inverse_depth": "depth",
    "normals": "normals",
    "labels": "labels",
    "mask": "labels",
    "valid": "labels",
    "seen": "seen",
    "rig": "rig",
}
"""Kinds of the entries of a sample, by their names."""

Parameters = dict[str, Tensor]


class _SphereAugmentation(nn.Module):
    """A random rotation of a tensor or of a sample; subclasses draw ``rotation``, and ``steps`` if it is exact."""

    def __init__(
        self,
        grid: SphereGrid,
        kinds: Mapping[str, str] | None,
        p: float,
        same_on_batch: bool,
        generator: torch.Generator | None,
    ) -> None:
        super().__init__()
        if not 0 <= p <= 1:
            raise ArgumentError(f"p: expected a probability from 0 to 1, got {p!r}")
        self.kinds = dict(USUAL_KINDS if kinds is None else kinds)
        for key, kind in self.kinds.items():
            check_choice(f"kinds[{key!r}]", kind, (*CONTENTS, "rig"))
        self.grid, self.p, self.same_on_batch, self.generator = grid, p, same_on_batch, generator
        self._params: Parameters = {}

    @abstractmethod
    def generate_parameters(self, batch_shape: tuple[int, ...]) -> Parameters:
        """Draw the rotations of a batch of ``batch_shape[0]`` samples."""

    def rotation(self, params: Parameters) -> Float[Tensor, "B 3 3"]:
        """Return the rotations ``(B, 3, 3)`` of parameters; the identity for samples that are not to be turned."""
        rotation = params["rotation"]
        return torch.where(params["batch_prob"][:, None, None], rotation, torch.eye(3).to(rotation))

    def forward_parameters(self, batch_shape: tuple[int, ...]) -> Parameters:
        """Draw the parameters of a batch: those of ``generate_parameters``, and in ``batch_prob`` which samples turn.

        With ``same_on_batch`` they are drawn for one sample, and used for all.
        """
        batch_shape = (1, *batch_shape[1:]) if self.same_on_batch else batch_shape
        params = self.generate_parameters(batch_shape)
        chosen = torch.rand(batch_shape[0], generator=self.generator) < self.p
        return {**params, "batch_prob": chosen}

    def forward(self, data: Any, params: Parameters | None = None) -> Any:
        """Turn a tensor, an image, or the entries of a sample, by ``params`` or else by new random ones."""
        self._params = self.forward_parameters((self._batch_size(data),)) if params is None else params
        return self._applied(data, self._params)

    def inverse(self, data: Any, params: Parameters | None = None) -> Any:
        """Turn back what these parameters, or else the last ones, have turned."""
        params = self._params if params is None else params
        if not params:
            raise ArgumentError("params: nothing was turned yet; call the module first or pass parameters")
        inverse = {**params, "rotation": params["rotation"].mT}
        if "steps" in params:
            inverse["steps"] = -params["steps"]
        return self._applied(data, inverse)

    def extra_repr(self) -> str:
        return f"p={self.p}, same_on_batch={self.same_on_batch}"

    def _applied(self, data: Any, params: Parameters) -> Any:
        if isinstance(data, Tensor):
            return self._entry("input", data, "image", params)
        if others := [key for key in data if key.startswith("panorama") and key not in self.kinds]:
            raise ArgumentError(
                f"sample: {', '.join(others)} would stay as they are while the rig is turned; leave them out, or turn "
                "the sample by RotateFivefold"
            )
        turned = {
            key: self._entry(key, value, self.kinds[key], params) if key in self.kinds else value
            for key, value in data.items()
        }
        images, seen = turned.get("images"), turned.get("seen")
        if isinstance(images, Tensor) and isinstance(seen, Tensor):
            # What was not seen is not shown, mixed with what was.
            turned["images"] = torch.where(seen.unsqueeze(-len(self.grid.shape) - 1), images, 0.0)
        return turned

    def _entry(self, key: str, value: Any, kind: str, params: Parameters) -> Any:
        one_for_all = len(params["batch_prob"]) == 1
        if kind == "rig":
            rotation = self.rotation(params)
            return value.rotated(rotation=rotation[0] if one_for_all else rotation)
        if isinstance(value, Mapping):  # what cameras saw: they turn with the world and see the same
            return value
        params = {name: tensor.to(value.device) for name, tensor in params.items()}
        if one_for_all:
            params = {name: tensor[0] for name, tensor in params.items()}
        try:
            if "steps" in params:
                moved = yaw_on_sphere(value, self.grid, params["steps"], kind)
            else:
                moved = rotate_on_sphere(value, self.grid, params["rotation"], kind)
        except ShapeError as error:
            single = "" if one_for_all else "; for samples without a batch dimension use same_on_batch=True"
            raise ShapeError(f"{key}: {error}{single}") from None
        chosen = params["batch_prob"]
        return torch.where(chosen.view(*chosen.shape, *(1,) * (value.ndim - chosen.ndim)), moved, value)

    def _batch_size(self, data: Any) -> int:
        if self.same_on_batch:
            return 1
        if isinstance(data, Tensor):
            return data.shape[0]
        for key, value in data.items():
            if key in self.kinds and isinstance(value, Tensor):
                return value.shape[0]
            if key in self.kinds and isinstance(value, CameraRig) and value.world_from_camera.ndim == 4:
                return value.world_from_camera.shape[0]
        raise ArgumentError(
            f"sample: expected an entry to turn, one of {', '.join(self.kinds)}, got {', '.join(data)}"
        )


class RandomSphereRotation(_SphereAugmentation):
    """Rotate samples at random in three dimensions: images, depth, normals, labels on one grid, and the rig's poses.

    Args:
        grid: on which everything lies.
        kinds: what entries of a sample are, by name: ``"image"``, ``"depth"``, ``"normals"``, ``"labels"``,
            ``"seen"`` (see ``rotate_on_sphere``) or ``"rig"``. The usual names are known when not given: image, images,
            depth, inverse_depth, normals, labels, mask, valid, seen, rig. Entries of other names stay as they are.
        max_angle: largest angle in radians; π draws evenly from all rotations.
        p: probability with which a sample is rotated.
        same_on_batch: one rotation for all samples of a batch, or for a sample without a batch dimension.
        generator: source of randomness; torch's global one when not given.

    Entries are ``(B, c, *grid.shape)``, or ``(B, *grid.shape)`` for depth and labels; a tensor instead of a sample is
    an image. Where a sample has ``seen``, its ``images`` are 0 wherever that is False. Images by camera's name, as they
    are before ``ToSphere``, stay, and so does what was seen of them: the cameras turn with the world.

    Raises:
        ArgumentError: if an argument is out of range, or a sample has nothing to turn.
        ShapeError: if an entry does not lie on the grid; the message names it.

    Examples:
        >>> from sphericalvision.icosphere import Icosphere
        >>> augment = RandomSphereRotation(Icosphere(3))
        >>> image = torch.rand(2, 3, 642)
        >>> turned = augment(image)
        >>> torch.equal(turned, augment(image, params=augment._params))
        True
    """

    def __init__(
        self,
        grid: SphereGrid,
        kinds: Mapping[str, str] | None = None,
        max_angle: float = math.pi,
        p: float = 1.0,
        same_on_batch: bool = False,
        generator: torch.Generator | None = None,
    ) -> None:
        super().__init__(grid, kinds, p, same_on_batch, generator)
        random_rotations(0, max_angle)
        self.max_angle = max_angle

    def generate_parameters(self, batch_shape: tuple[int, ...]) -> Parameters:
        """Draw ``rotation`` ``(B, 3, 3)``."""
        return {"rotation": random_rotations(batch_shape[0], self.max_angle, self.generator)}

    def extra_repr(self) -> str:
        return f"max_angle={self.max_angle:.4g}, {super().extra_repr()}"


class RandomYaw(_SphereAugmentation):
    """Turn samples at random about the vertical: images, depth, normals, labels on one grid, and the rig's poses.

    Args:
        grid: on which everything lies.
        kinds: what entries of a sample are, by name; see ``RandomSphereRotation``.
        angles: ``"grid"`` for turns that map the grid onto itself, where nothing is interpolated (whole columns of an
            ``Equirectangular``, fifths of a turn of an ``Icosphere``, quarters of ``Cubemap`` and ``Healpix``), or
            ``"any"``.
        p: probability with which a sample is turned.
        same_on_batch: one turn for all samples of a batch, or for a sample without a batch dimension.
        generator: source of randomness; torch's global one when not given.

    Raises:
        ArgumentError: the grid has no exact turns.

    Examples:
        >>> from sphericalvision.sphere import Equirectangular
        >>> augment = RandomYaw(Equirectangular(4, 8))
        >>> image = torch.rand(2, 3, 4, 8)
        >>> torch.equal(augment.inverse(augment(image)), image)
        True
    """

    def __init__(
        self,
        grid: SphereGrid,
        kinds: Mapping[str, str] | None = None,
        angles: str = "grid",
        p: float = 1.0,
        same_on_batch: bool = False,
        generator: torch.Generator | None = None,
    ) -> None:
        super().__init__(grid, kinds, p, same_on_batch, generator)
        check_choice("angles", angles, ("grid", "any"))
        self.angles = angles
        if angles == "grid":
            num_yaw_steps(grid)

    def generate_parameters(self, batch_shape: tuple[int, ...]) -> Parameters:
        """Draw ``rotation`` ``(B, 3, 3)``, and ``steps`` ``(B,)`` where the grid is mapped onto itself."""
        if self.angles == "grid":
            count = num_yaw_steps(self.grid)
            steps = torch.randint(count, batch_shape[:1], generator=self.generator)
            return {"steps": steps, "rotation": yaw_rotation(yaw_angle(steps, count))}
        angle = 2 * math.pi * torch.rand(batch_shape[:1], generator=self.generator)
        return {"rotation": yaw_rotation(angle)}

    def extra_repr(self) -> str:
        return f"angles={self.angles!r}, {super().extra_repr()}"
