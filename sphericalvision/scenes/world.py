# SPDX-License-Identifier: Apache-2.0
"""``World``: what a seed stands for. A scene, a rig in it, what carries the rig, faults, images, and the truth."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from functools import cached_property
from hashlib import sha256
from typing import Any, TypeAlias

import torch
from jaxtyping import Float
from torch import Tensor

from sphericalvision import __version__
from sphericalvision.cameras import CameraRig
from sphericalvision.cameras.fingerprint import rig_fingerprint
from sphericalvision.core import ArgumentError, check_choice
from sphericalvision.scenes.carriers import CARRIERS, Carried, carrier_masks, with_carrier
from sphericalvision.scenes.clutter import with_clutter
from sphericalvision.scenes.disturbances import DISPLAY, CameraDisturbance, RandomFaults, turned_poses
from sphericalvision.scenes.draws import Draws, choose
from sphericalvision.scenes.meshes import MeshFiles
from sphericalvision.scenes.procedural import exposed, make_scene, under_another_sky, unlit
from sphericalvision.scenes.random_rigs import TILT_SPREAD
from sphericalvision.scenes.registry import kind_of, scene_kinds
from sphericalvision.scenes.rendering.mesh_scene import MeshScene
from sphericalvision.scenes.rendering.render import ray_depth, render_rig
from sphericalvision.scenes.rendering.scene import Scene

#: Scenes of this seed and above are kept for comparing methods: no training, validation or test of one uses them.
HELD_OUT_SEED = 10_000_000
#: Least depth, and free space around the rig, of scenes at their natural scale (metres).
NATURAL_MIN_DEPTH, CLEAR_RADIUS = 0.55, 0.6

Images: TypeAlias = Mapping[str, Tensor]
"""Camera name -> ``(3, h, w)`` in [0, 1]."""


def rendered(frame: WorldFrame) -> Images:
    """What the cameras of a frame would take without faults."""
    return render_rig(frame.shown, frame.true_rig, frame.world.samples_per_pixel)


@dataclass(frozen=True)
class World:
    """What seeds stand for; ``frame(seed)`` makes it.

    Shares say how often something is drawn, 0 to 1. What is not given does not happen.

    Args:
        rig: unbatched, of one size for all seeds; or what draws one from a generator, around the origin.
        kind: of ``make_scene``, several that take turns from seed to seed, or how often each comes, by its name.
        min_depth: least depth that the network tells apart, metres. Scenes scale with it: 0.55 is natural size; meshes
            have the size that they have.
        meshes: of which scenes are made in place of a kind.
        tilts: least and largest radians by which all cameras look further down, drawn for each seed; each camera then
            looks up to 8° further up or down.
        carrier: what carries the rig and is in view, see ``with_carrier``; or the share of seeds that have one, drawn
            from all, where the rig has no masks that would hide it.
        masked: share of carriers that the rig's masks hide.
        clutter: share of scenes with people, screens of bars and furniture around the rig, see ``with_clutter``.
        carrier_counts: whether depth is that of the carrier where that is in view, or that of the scene behind it.
        other_sky: share of scenes under a sky that is not theirs.
        unlit: share of scenes without lamps.
        too_bright: share of seeds that are too bright in all cameras, so that bright walls have no texture.
        stops: least and largest amount by which they are, in factors of two.
        faults: of the cameras.
        prepare: makes of a rig and its images those that are used, as the network will have them in use.
        samples_per_pixel: rays through each pixel.
        render: images without faults.

    Raises:
        ArgumentError: unknown kinds or carriers, a carrier in a mesh, or shares out of range.

    Examples:
        >>> from sphericalvision.cameras import ring_rig
        >>> frame = World(ring_rig(3, image_size=(24, 24)), ["room", "floating"], carrier="pole").frame(7)
        >>> frame.name, frame.images["cam1"].shape, frame.inverse_depth(torch.eye(3)).shape
        ('floating-pole-00000007', torch.Size([3, 24, 24]), torch.Size([3]))
    """

    rig: CameraRig | Callable[[torch.Generator], CameraRig]
    kind: str | Sequence[str] | Mapping[str, float] = "room"
    min_depth: float = NATURAL_MIN_DEPTH
    meshes: MeshFiles | None = None
    tilts: tuple[float, float] | None = None
    carrier: str | float | None = None
    masked: float = 0.0
    clutter: float = 0.0
    carrier_counts: bool = False
    other_sky: float = 0.0
    unlit: float = 0.0
    too_bright: float = 0.0
    stops: tuple[float, float] = (0.0, 0.0)
    faults: CameraDisturbance | RandomFaults = field(default_factory=CameraDisturbance)
    prepare: Callable[[CameraRig, Images], Images] | None = None
    samples_per_pixel: int = 1
    render: Callable[[WorldFrame], Images] = rendered

    def __post_init__(self) -> None:
        if isinstance(self.kind, Mapping):
            if set(self.kind) - set(scene_kinds()) or not sum(self.kind.values()) > 0:
                raise ArgumentError(
                    f"shares: expected some of {', '.join(scene_kinds())}, got {dict(self.kind)}"
                )
        elif self.meshes is None:
            kind_of(self.kind, 0)
        if isinstance(self.carrier, str):
            check_choice("carrier", self.carrier, CARRIERS)
        if self.meshes is not None and (self.carrier is not None or self.clutter):
            raise ArgumentError(
                "carrier: what carries the rig, and clutter, can be put into generated scenes, not into meshes"
            )
        for name in ("carrier", "masked", "clutter", "other_sky", "unlit", "too_bright"):
            probability = getattr(self, name)
            if isinstance(probability, int | float) and not 0 <= probability <= 1:
                raise ArgumentError(f"{name}: expected a share from 0 to 1, got {probability}")
        if self.tilts is not None and (self.carrier is not None or not self.tilts[0] <= self.tilts[1]):
            raise ArgumentError(
                f"tilts: expected (least, largest) in radians and no carrier, got {tuple(self.tilts)} and "
                f"{self.carrier}"
            )
        if not self.min_depth > 0:
            raise ArgumentError(f"min_depth: expected metres above 0, got {self.min_depth}")

    @property
    def scale(self) -> float:
        """Of the scenes' lengths."""
        return self.min_depth / NATURAL_MIN_DEPTH

    def check_free_space(self, rig: CameraRig) -> None:
        """Raise ``ArgumentError`` if cameras lie farther from the centre of a rig than the space that is kept free."""
        radius = (rig.positions - rig.center).norm(dim=-1).max().item()
        if radius >= CLEAR_RADIUS * self.scale:
            raise ArgumentError(
                f"rig: its cameras lie up to {radius:.2f} m from its centre, but scenes of min_depth "
                f"{self.min_depth} keep only {CLEAR_RADIUS * self.scale:.2f} m free; give a min_depth above "
                f"{radius / CLEAR_RADIUS * NATURAL_MIN_DEPTH:.2f}"
            )

    @classmethod
    def of(cls, values: Mapping[str, Any], **more: Any) -> World:
        """Make a world of plain values, as a file holds them, and of ``more`` that it cannot hold.

        Raises:
            ArgumentError: a name that is no argument, or values that do not fit.
        """
        names = tuple(each.name for each in fields(cls))
        for name in values:
            check_choice("world", name, names)
        chosen = {**values, **more}
        if isinstance(chosen.get("faults"), Mapping):
            chosen["faults"] = RandomFaults.of(chosen["faults"])
        return cls(**chosen)

    def fingerprint(self, *more: object) -> str:
        """Sixteen characters that change with everything but the meshes, which tell themselves by names of frames.

        They change with the version of this package, as recipes and renderer may.

        Args:
            more: whatever else tells fingerprints apart, by its ``repr``.

        Examples:
            >>> from sphericalvision.cameras import ring_rig
            >>> one, other = World(ring_rig(3)), World(ring_rig(3), samples_per_pixel=2)
            >>> one.fingerprint() == World(ring_rig(3)).fingerprint(), one.fingerprint() == other.fingerprint()
            (True, False)
        """
        values = [getattr(self, each.name) for each in fields(self) if each.name not in ("meshes", "rig")]
        plain = [f"{v.__module__}.{v.__qualname__}" if hasattr(v, "__qualname__") else v for v in values]
        content = (__version__, plain, more)
        if isinstance(self.rig, CameraRig):
            return rig_fingerprint(self.rig, content)
        return sha256(repr((self.rig, content)).encode()).hexdigest()[:16]

    def frame(self, seed: int) -> WorldFrame:
        """All that a seed stands for; nothing is made before it is asked for."""
        return WorldFrame(self, seed)


class WorldFrame:
    """What one seed stands for in a world. Each part is made once, when it is first asked for."""

    def __init__(self, world: World, seed: int) -> None:
        self.world, self.seed, self.draws = world, seed, Draws.of(seed)

    @cached_property
    def kind(self) -> str:
        """Of the scene."""
        if not isinstance(self.world.kind, Mapping):
            return kind_of(self.world.kind, self.seed)
        probabilities = torch.tensor(list(self.world.kind.values()))
        return list(self.world.kind)[choose(probabilities, self.draws.kind)]

    @property
    def name(self) -> str:
        """Kind or mesh, a carrier that is always there, and the seed."""
        if self.world.meshes is not None:
            return self.world.meshes.name(self.seed)
        always = f"-{self.world.carrier}" if isinstance(self.world.carrier, str) else ""
        return f"{self.kind}{always}-{self.seed:08d}"

    @cached_property
    def true_rig(self) -> CameraRig:
        """The rig that takes the images."""
        if not isinstance(self.world.rig, CameraRig):
            return self.world.rig(self.draws.rig)
        if self.world.tilts is None:
            return self.world.rig
        least, most = self.world.tilts
        tilt = least + (most - least) * torch.rand((), generator=self.draws.rig)
        offsets = 2 * torch.rand(len(self.world.rig), generator=self.draws.rig) - 1
        return self.world.rig.rotated(tilt=tilt + TILT_SPREAD * offsets)

    @property
    def center(self) -> Float[Tensor, " 3"]:
        """Where depth is measured from, metres."""
        return self.world.rig.center if isinstance(self.world.rig, CameraRig) else self.true_rig.center

    @cached_property
    def scene(self) -> Scene | MeshScene:
        """The scene without what carries the rig."""
        world = self.world
        # Rigs that are drawn are around the origin but for rounding, and so are their scenes.
        center = self.center if isinstance(world.rig, CameraRig) else None
        if world.meshes is not None:
            return world.meshes.make(self.seed, CLEAR_RADIUS * world.scale, center)
        scene = make_scene(self.kind, self.seed, center=center, scale=world.scale, clear_radius=CLEAR_RADIUS)
        if world.unlit or world.other_sky:
            dull, skies = torch.rand(2, generator=self.draws.sky).tolist()
            if dull < world.unlit:
                scene = exposed(unlit(scene), 0.45, center)
            if skies < world.other_sky:
                scene = under_another_sky(scene, self.draws.sky)
        if torch.rand((), generator=self.draws.clutter) < world.clutter:
            start = torch.zeros(3) if center is None else center
            scene = with_clutter(scene, start, self.draws.clutter, CLEAR_RADIUS, world.scale)
        return scene

    @cached_property
    def _carried(self) -> tuple[Carried | None, bool]:
        """The scene with what carries the rig in it, and whether masks hide that."""
        scene, rig, draws = self.scene, self.true_rig, self.draws.carrier
        kind = self.world.carrier
        if not isinstance(kind, str):
            if not kind or rig.masks or torch.rand((), generator=draws) >= kind:
                return None, False
            kind = CARRIERS[int(torch.randint(len(CARRIERS), (), generator=draws))]
        masked = bool(torch.rand((), generator=draws) < self.world.masked)
        assert isinstance(scene, Scene)  # no mesh, as World has checked
        return with_carrier(scene, kind, rig, self.seed), masked

    @property
    def shown(self) -> Scene | MeshScene:
        """The scene as the cameras see it."""
        carried, _ = self._carried
        return self.scene if carried is None else carried.scene

    @cached_property
    def free(self) -> dict[str, Tensor]:
        """By camera name where its image is free of what carries the rig; nothing where nothing is in view."""
        carried, _ = self._carried
        return {} if carried is None else carrier_masks(carried.body, self.true_rig)

    @cached_property
    def faults(self) -> CameraDisturbance:
        """What is wrong with the cameras."""
        faults = self.world.faults
        return faults if isinstance(faults, CameraDisturbance) else faults.draw(self.draws.faults)

    @cached_property
    def gain(self) -> float:
        """Factor on the values of all images."""
        if not self.world.too_bright:
            return 1.0
        happens, amount = torch.rand(2, generator=self.draws.brightness).tolist()
        least, most = self.world.stops
        stops = least + (most - least) * amount if happens < self.world.too_bright else 0.0
        return float(2 ** (stops / DISPLAY))

    @cached_property
    def taken(self) -> Images:
        """The images that the cameras take, faults and all."""
        images, faults, cameras = self.world.render(self), self.faults, self.true_rig.cameras
        return {
            name: faults.image((self.gain * image).clamp(max=1), cameras[name], self.draws.images)
            for name, image in images.items()
        }

    @cached_property
    def posed_rig(self) -> CameraRig:
        """The rig with the poses that its calibration has."""
        if not self.faults.pose_error:
            return self.true_rig
        images = self.draws.images  # what is drawn for images comes first
        if "taken" not in self.__dict__:  # blank ones, since what is drawn does not depend on what they show
            images = Draws.of(self.seed).images
            for camera in self.true_rig.cameras.values():
                self.faults.image(torch.zeros(3, *camera.image_size), camera, images)
        return turned_poses(self.true_rig, self.faults.pose_error, images)

    @cached_property
    def rig(self) -> CameraRig:
        """The rig as its calibration has it, with masks where these hide its carrier."""
        _, masked = self._carried
        rig = self.posed_rig
        if not masked:
            return rig
        masks = {name: free & rig.masks.get(name, free) for name, free in self.free.items()}
        return rig.replaced(masks=masks)

    @cached_property
    def images(self) -> Images:
        """The images that are used, prepared."""
        prepare, taken = self.world.prepare, self.taken
        return taken if prepare is None else prepare(self.rig, taken)

    def inverse_depth(self, directions: Float[Tensor, "*rays 3"]) -> Float[Tensor, "*rays"]:
        """The truth in 1/m along rays from the rig's centre, exact, 0 at infinity."""
        scene = self.shown if self.world.carrier_counts else self.scene
        return ray_depth(scene, self.center, directions).reciprocal()
