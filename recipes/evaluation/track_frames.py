# SPDX-License-Identifier: Apache-2.0
"""The frames of a track: what the cameras show, what methods are told of the rig, and the truth."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from functools import lru_cache, partial
from pathlib import Path
from typing import Annotated, Any, NamedTuple

from annotated_types import Ge
from pydantic.dataclasses import dataclass
from torch import Tensor

from sphericalvision import __version__
from sphericalvision.cameras import CameraRig
from sphericalvision.cameras.fingerprint import rig_fingerprint
from sphericalvision.capture import Predictor, align_rig
from sphericalvision.capture.preparation.preparation import AS_IT_IS, Preparation
from sphericalvision.icosphere import Icosphere
from sphericalvision.models import DepthNetwork, pretrained
from sphericalvision.models.weights.files import identity_of
from sphericalvision.recipes.app.kinds import STRICT, Count
from sphericalvision.recipes.evaluation.tracks import Track
from sphericalvision.scenes import render_directions
from sphericalvision.scenes.cache import ArrayCache, decode, encode
from sphericalvision.scenes.meshes import mesh_files
from sphericalvision.scenes.world import NATURAL_MIN_DEPTH, World, WorldFrame, rendered
from sphericalvision.sphere import Equirectangular

DRAWN = (0, 3, 4)
"""Indices of the frames that are drawn; where kinds of scenes take turns a corridor, outdoors and a room."""


@dataclass(frozen=True, config=STRICT)
class Size:
    """Resolution of frames, and their preparation; ``conf/benchmark.yaml`` explains its keys.

    By its preparation images and rig are made ready for all methods alike, as ``sphericalvision-predict`` does; cameras
    are turned by the depth of the network that ships.
    """

    level: Annotated[int, Ge(3)] = 6
    panorama_rows: Annotated[int, Ge(2)] = 320
    image_rows: Annotated[int, Ge(8)] = 256
    samples_per_pixel: Count = 2
    preparation: Preparation = Preparation()


class TrackFrame(NamedTuple):
    """One frame of a track.

    Attributes:
        name: kind and seed of the scene.
        images: camera name -> ``(3, h, w)`` in [0, 1], disturbed, and compensated where ``Size`` says so.
        rig: as its calibration says, which may be wrong.
        free_rig: the same, its masks free of what carries the rig, whether methods are told of it or not: where two of
            its cameras see a point, the point counts.
        inverse_depth: ``(V,)`` in 1/m at the vertices of ``Size.level``, from the rig's centre, of the scene without
            what carries the rig: nobody asks how far the vehicle is.
        panorama: ``(h, 2h)`` the same for pixels.
        colors: ``(3, V)`` in [0, 1], the undisturbed view from the rig's centre.
        shared_rigs: rigs that must all see a point with two cameras where the track compares the same points.
    """

    name: str
    images: dict[str, Tensor]
    rig: CameraRig
    free_rig: CameraRig
    inverse_depth: Tensor
    panorama: Tensor
    colors: Tensor
    shared_rigs: tuple[CameraRig, ...]


def render_frame(track: Track, number: int, size: Size, cache: Path | None = None) -> TrackFrame:
    """Make a frame of a track; what cameras see is kept in ``cache``, the rest is soon computed.

    Args:
        track: which one.
        number: of the frame, from 0.
        size: how fine.
        cache: folder of renderings, shared by tracks; none is kept without one.

    Examples:
        >>> from sphericalvision.recipes.evaluation.tracks import TRACKS
        >>> frame = render_frame(TRACKS["room"], 0, Size(level=3, panorama_rows=8, image_rows=16, preparation=AS_IT_IS))
        >>> frame.name, frame.images["cam1"].shape, frame.panorama.shape
        ('room-10000000', torch.Size([3, 16, 16]), torch.Size([8, 16]))
    """
    seed = track.seed(number)
    rig, name = track.make_rig(seed, size.image_rows), track.frame_name(number)
    world = World(
        rig,
        track.kind,
        meshes=mesh_files(list(track.meshes)) if track.meshes else None,
        carrier=track.carrier,
        masked=float(track.masked),
        faults=track.disturbance,
        prepare=size.preparation.of_images,
        samples_per_pixel=size.samples_per_pixel,
        render=partial(_rendered, name if track.carrier is None else f"{name}-{track.carrier}", cache),
    )
    frame = world.frame(seed)
    vertices = Icosphere(size.level).vertices
    around = Equirectangular(size.panorama_rows, 2 * size.panorama_rows).directions
    return TrackFrame(
        name,
        dict(frame.images),
        _aligned(frame.rig, frame.images) if size.preparation.judges(frame.rig) else frame.rig,
        rig.replaced(world_from_camera=frame.posed_rig.world_from_camera, masks=frame.free),
        frame.inverse_depth(vertices),
        frame.inverse_depth(around),
        render_directions(frame.scene, rig.center, vertices),
        tuple(track.make_rig(seed, size.image_rows, tilt) for tilt in track.shared_tilts_deg),
    )


class TrackFrames:
    """Frames of a track by their numbers, each rendered when it is asked for; see ``render_frame``."""

    def __init__(self, track: Track, numbers: range, size: Size, cache: Path | None) -> None:
        self.track, self.name, self.size, self.cache = track, track.name, size, cache
        self.numbers = {track.frame_name(number): number for number in numbers}
        self.names = list(self.numbers)
        self.drawn = [self.names[index] for index in DRAWN if index < len(self.names)]

    @property
    def key(self) -> dict[str, Any]:
        """Settings that the frames depend on: track, size, and the network that turns cameras where one does."""
        key = {"track": repr(self.track), "size": asdict(self.size)}
        return key if self.size.preparation == AS_IT_IS else {**key, "aligner": _aligner_identity()}

    def frame(self, name: str) -> TrackFrame:
        """Render a frame."""
        return render_frame(self.track, self.numbers[name], self.size, self.cache)

    def batches(self, names: Sequence[str]) -> Iterator[tuple[Sequence[str], TrackFrame]]:
        """Each frame by itself."""
        for name in names:
            yield [name], self.frame(name)


def _rendered(name: str, cache: Path | None, frame: WorldFrame) -> Mapping[str, Tensor]:
    """Images of the cameras, rounded to bytes as cameras give them."""
    numbers = (__version__, frame.world.samples_per_pixel, NATURAL_MIN_DEPTH)
    folder = None if cache is None else cache / f"benchmark-{rig_fingerprint(frame.true_rig, numbers)}"

    def make() -> dict[str, Tensor]:
        return {name: encode(image) for name, image in rendered(frame).items()}

    return {key: decode(image) for key, image in ArrayCache(folder).get(name, make).items()}


def _aligned(rig: CameraRig, images: Mapping[str, Tensor]) -> CameraRig:
    """The rig with cameras turned where its images ask for it."""
    predictor = Predictor(rig, aligner(), min_depth=NATURAL_MIN_DEPTH, preparation=AS_IT_IS)
    return align_rig(predictor, [{name: image.clamp(0, 1) for name, image in images.items()}]).rig


@lru_cache(maxsize=1)
def aligner() -> DepthNetwork:
    """The network by whose depth cameras are turned."""
    return pretrained()


@lru_cache(maxsize=1)
def _aligner_identity() -> str:
    return identity_of(aligner())
