# SPDX-License-Identifier: Apache-2.0
"""The tracks of the benchmark: which scenes, through which rig, disturbed how. Only data; a new track is one line."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import torch

from sphericalvision.cameras import CameraRig
from sphericalvision.core import ArgumentError, check_choice
from sphericalvision.recipes.app.rigs import make_corner_rig, make_panorama_ring, make_ring
from sphericalvision.scenes.disturbances import DISTURBANCES, CameraDisturbance
from sphericalvision.scenes.meshes import mesh_files
from sphericalvision.scenes.random_rigs import random_rig
from sphericalvision.scenes.registry import TURNS, kind_of, scene_kinds
from sphericalvision.scenes.world import HELD_OUT_SEED

TILTS_DEG = (0.0, 15.0, 30.0, 45.0)


@dataclass(frozen=True)
class Track:
    """Frames that ask one question.

    Attributes:
        name: of its row, files and folders.
        group: tracks that belong together.
        kind: of scenes; several take turns.
        rig: around the origin: "ring", "panoramas", "corners" (of a vehicle) or "random", another one for each frame.
        num_cameras: of a ring.
        radius: of a ring, metres.
        tilt_deg: by which every camera looks further down.
        disturbance: of images and poses.
        carrier: what carries the rig and is in view; none when not given.
        masked: whether the rig is told where its carrier is in the images.
        shared_tilts_deg: tilts at which a point must have two cameras, all of them, to count: so that tracks that
            differ in tilt compare the same points.
        meshes: files of which scenes are made in place of a kind.
    """

    name: str
    group: str
    kind: str | tuple[str, ...] = TURNS
    rig: Literal["ring", "panoramas", "corners", "random"] = "ring"
    num_cameras: int = 4
    radius: float = 0.2
    tilt_deg: float = 0.0
    disturbance: CameraDisturbance = field(default_factory=CameraDisturbance)
    carrier: str | None = None
    masked: bool = False
    shared_tilts_deg: tuple[float, ...] = ()
    meshes: tuple[str, ...] = ()

    def seed(self, number: int) -> int:
        """The seed of a frame; the same in all tracks, so that they share scenes, and none that training uses."""
        if number < 0:
            raise ArgumentError(f"number: expected 0 or more, got {number}: seeds below are for training")
        return HELD_OUT_SEED + number

    def frame_name(self, number: int) -> str:
        """Kind and seed of a frame's scene."""
        seed = self.seed(number)
        if self.meshes:
            return mesh_files(list(self.meshes)).name(seed)
        return f"{kind_of(self.kind, seed)}-{seed:08d}"

    def make_rig(self, seed: int, image_rows: int = 256, tilt_deg: float | None = None) -> CameraRig:
        """The rig of a frame.

        Args:
            seed: of the frame.
            image_rows: of fisheyes, which are square; panoramas have as many pixels in a degree.
            tilt_deg: in place of the track's own.
        """
        size = (image_rows, image_rows)
        if self.rig == "random":
            return random_rig(torch.Generator().manual_seed(seed), image_size=size)
        if self.rig == "panoramas":
            rows = round(image_rows * 180 / 220 / 8) * 8
            rig = make_panorama_ring(self.num_cameras, self.radius, (rows, 2 * rows))
        elif self.rig == "corners":
            rig = make_corner_rig(image_size=size)
        else:
            rig = make_ring(self.num_cameras, self.radius, size)
        tilt = self.tilt_deg if tilt_deg is None else tilt_deg
        return rig.rotated(tilt=math.radians(tilt)) if tilt else rig


SLIGHT, LARGE = math.radians(0.3), math.radians(1.0)
DISTURBANCE_TRACKS = {
    "clean": CameraDisturbance(),
    "grey": CameraDisturbance(grey=True),
    "exposure": CameraDisturbance(exposure=0.7, white_balance=0.15),
    "noise": CameraDisturbance(noise=0.03),
    "vignetting": CameraDisturbance(vignetting=0.6),
    "blur": CameraDisturbance(blur=1.0),
    "pose_0.3": CameraDisturbance(pose_error=SLIGHT),
    "pose_1.0": CameraDisturbance(pose_error=LARGE),
}
TOGETHER = CameraDisturbance(True, 0.4, 0.5, 0.4, 0.1, 0.02, SLIGHT)

TRACKS: dict[str, Track] = {
    track.name: track
    for track in (
        *(Track(kind, "scenes", kind) for kind in ("room", "floating")),
        Track("mixed", "scenes", ("room", "floating")),
        *(Track(kind, "scenes", kind) for kind in scene_kinds()[2:]),
        *(Track(f"tilt_{t:.0f}", "tilts", tilt_deg=t, shared_tilts_deg=TILTS_DEG) for t in TILTS_DEG),
        *(Track(f"cameras_{n}", "rigs", num_cameras=n) for n in (2, 3, 5, 6)),
        *(Track(f"radius_{100 * r:.0f}cm", "rigs", radius=r) for r in (0.1, 0.3, 0.4)),
        Track("random", "rigs", rig="random"),
        Track("panoramas", "rigs", rig="panoramas"),
        Track("ugv", "rigs", rig="corners", carrier="vehicle"),
        Track("ugv_masked", "rigs", rig="corners", carrier="vehicle", masked=True),
        *(Track(name, "disturbances", disturbance=way) for name, way in DISTURBANCE_TRACKS.items()),
        Track("carrier", "disturbances", carrier="robot"),
        Track("carrier_masked", "disturbances", carrier="robot", masked=True),
        Track("together", "disturbances", disturbance=TOGETHER, carrier="pole"),
    )
}
"""All tracks by name; meshes of one's own make one more."""

GROUPS = tuple(dict.fromkeys(track.group for track in TRACKS.values()))


def chosen_tracks(words: Sequence[str], meshes: Sequence[str] = ()) -> list[Track]:
    """The tracks of some names, or names of groups, in the order of the table; ``"all"`` is every one.

    A disturbance of one's own, of ``register_disturbance``, is a track by its name, at amounts of 0.5 to 1.

    Raises:
        ArgumentError: an unknown name.

    Examples:
        >>> [track.name for track in chosen_tracks(["tilts", "room"])]
        ['room', 'tilt_0', 'tilt_15', 'tilt_30', 'tilt_45']
    """
    tracks = dict(TRACKS)
    if meshes:
        tracks["meshes"] = Track("meshes", "meshes", "mesh", meshes=tuple(meshes))
    for word in words:
        check_choice("tracks", word, ("all", *GROUPS, *tracks, *DISTURBANCES.names()))
        if word not in ("all", *GROUPS, *tracks):
            tracks[word] = Track(word, "disturbances", disturbance=CameraDisturbance(others={word: 1.0}))
    selected = set(words)
    return [t for t in tracks.values() if "all" in selected or selected & {t.name, t.group} or t.meshes]
