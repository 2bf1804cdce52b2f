# SPDX-License-Identifier: Apache-2.0
"""``Predictor``: a rig and a network in one thing that is called with images and answers with depth."""

from __future__ import annotations

import copy
import os
import threading
from collections.abc import Iterable, Mapping
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any, Literal, NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sphericalvision.cameras import CameraRig
from sphericalvision.cameras.base import check_single
from sphericalvision.capture.depth import Depth
from sphericalvision.capture.preparation.alignment import RigTurns, judged_rig, untold
from sphericalvision.capture.preparation.nearest import (
    SCENE_LEVEL,
    NearestHypothesis,
    check_places,
    checked_min_depth,
    nearest_hypothesis,
)
from sphericalvision.capture.preparation.preparation import Compensation, Compensator, Preparation
from sphericalvision.core import ArgumentError, check_choice, check_type, full_precision
from sphericalvision.geometry.directions import angle_from_axis
from sphericalvision.icosphere import icosphere_vertices
from sphericalvision.icosphere.topology import check_level
from sphericalvision.models import DepthNetwork, SemiGlobalSweep
from sphericalvision.models.weights.checkpoints import read_network
from sphericalvision.sphere.intake import Intake, as_photographs, signed
from sphericalvision.sweep.hypotheses import check_hypotheses

__all__ = ["METHODS", "Predictor"]

METHODS = ("network", "semi_global")


class _Ready(NamedTuple):
    """What is made once for a rig: the network at its scale, its tables, and what makes images into those it takes."""

    net: DepthNetwork
    tables: Any
    intake: Intake
    compensator: Compensator
    angles: Tensor
    """``(n, V)`` radians from each camera's axis; empty for networks that take images as they are."""


class Predictor:
    """Depth all around from the images of a rig.

    All tables of the rig are computed once. Calls may come from several threads. On a CPU they run in parallel if
    torch leaves them cores: ``torch.set_num_threads(1)`` in each thread gives the most frames per second. If each call
    uses more than half of the cores, and on a GPU, calls wait for each other. Copies and pickles are predictors of
    their own, with the tables as far as these are made.

    Args:
        rig: calibrated cameras, for instance ``cameras.read_rig("capture/config.yaml")``; its masks are used.
        weights: a name of ``models.available_weights()``, a weights file, or a network; by default the one that
            ships for ``level``: ``refinedsweepnet-fast`` for 5, ``refinedsweepnet-fine`` for 7.
        method: ``"network"``, or ``"semi_global"``: a sweep without training at the level of the network.
        min_depth: nearest hypothesis in metres. ``"scene"`` estimates it from the first images, once, which takes one
            to three seconds. ``None`` is that of the training, scaled with the rig if the network was trained with rigs
            of one radius (``net.min_depth_follows``). ``"auto"`` is that, too, unless the network was trained with rigs
            of many radii and the first images show a scene four times nearer or farther; without training it is
            ``"scene"``.
        level: icosphere level of the images; by default that of the training, 6 if no weights are given. One level
            less is three times as fast.
        num_hypotheses: N; by default that of the training.
        device: where to compute; by default the device of the network, which is the CPU if it was read from weights.
        antialias: whether images finer than the icosphere are averaged over the area between its vertices.
        preparation: how images are made ready before depth is estimated, ``Preparation()`` when not given: noise is
            smoothed, light compensated. Cameras are turned by ``prepare``, which looks at a few frames.
        channels: order of the channels of colour images: ``"rgb"``, or ``"bgr"`` as OpenCV reads them.
        trained_radius: metres; radius of the rigs that the network was trained with.

    Raises:
        ArgumentError: the network is for another number of cameras, or an argument makes no sense.

    Examples:
        >>> from sphericalvision.cameras import ring_rig
        >>> from sphericalvision.scenes import make_scene, render_rig
        >>> rig = ring_rig(4, image_size=(64, 64))
        >>> predictor = Predictor(rig, method="semi_global", level=4, min_depth=0.55)
        >>> depth = predictor(render_rig(make_scene("room", seed=1), rig))
        >>> depth.depth.shape, depth.panorama(32).depth.shape, depth.camera("cam1").depth.shape
        (torch.Size([642]), torch.Size([32, 64]), torch.Size([64, 64]))
        >>> depth.points().points.shape[1]
        3
    """

    def __init__(
        self,
        rig: CameraRig,
        weights: str | Path | DepthNetwork | None = None,
        *,
        method: Literal["network", "semi_global"] = "network",
        min_depth: float | Literal["auto", "scene"] | None = "auto",
        level: int | None = None,
        num_hypotheses: int | None = None,
        device: torch.device | str | None = None,
        antialias: bool = True,
        preparation: Preparation | None = None,
        channels: Literal["rgb", "bgr"] = "rgb",
        trained_radius: float = 0.2,
    ) -> None:
        check_type("rig", rig, CameraRig, "ring_rig makes one, read_rig reads one")
        check_single(rig)
        check_choice("method", method, METHODS)
        check_choice("channels", channels, ("rgb", "bgr"))
        net = weights if isinstance(weights, DepthNetwork) else read_network(weights, level)
        if level is not None:
            check_level(level)
        if num_hypotheses is not None:
            check_hypotheses(num_hypotheses, net.min_depth)
        if method == "network" and level is not None:
            net = net.with_changes(level=level)
        check_number(net, rig)
        if len(rig) < 2 and (method == "semi_global" or net.num_cameras > 1):
            raise ArgumentError(
                f"rig: expected two or more cameras, got {len(rig)} ({', '.join(rig.names)}): "
                "depth is what they see differently; add a camera (cameras=[...] of the command)"
            )
        if len(rig) > 1:
            check_places(rig)
        self._device = net.device if device is None else checked_device(device)
        self._rig = rig.to(self._device)
        self._antialias, self._channels = antialias, channels
        self.preparation = Preparation() if preparation is None else preparation
        self._lock = threading.Lock()
        self._ready: _Ready | None = None
        self._scaled: DepthNetwork | None = None
        self._net = net
        self._method, self._level, self._num_hypotheses = method, level, num_hypotheses
        self._nearest: NearestHypothesis = nearest_hypothesis(
            min_depth, net, rig, trained_radius, method == "network"
        )
        self._min_depth = self._nearest.metres

    @property
    def device(self) -> torch.device:
        """Where depth is computed."""
        return self._device

    @property
    def rig(self) -> CameraRig:
        """The cameras, on the device of the network."""
        return self._rig

    @property
    def min_depth(self) -> float | None:
        """Nearest hypothesis in metres; None as long as it has not been found in images."""
        return self._min_depth

    @property
    def network(self) -> DepthNetwork:
        """The network at the scale of the rig.

        Raises:
            ArgumentError: the scale is not known before the first images came (``min_depth="auto"`` or ``"scene"``).
        """
        return self._ready_now().net

    @property
    def tables(self) -> Any:
        """The network's tables of the rig, made once.

        Raises:
            ArgumentError: as ``network``.
        """
        return self._ready_now().tables

    @property
    def intake(self) -> Intake:
        """What makes images of the cameras into those that the network takes, made once.

        Raises:
            ArgumentError: as ``network``.
        """
        return self._ready_now().intake

    def with_rig(self, rig: CameraRig) -> Predictor:
        """The same for another rig, such as the next window of a camera that moves; the network is shared.

        Hypotheses stay as they are, unless the nearest is still to be found; tables are made anew.

        Args:
            rig: of any number of cameras, if the network takes that.

        Raises:
            ArgumentError: the network is for another number of cameras.

        Examples:
            >>> from sphericalvision.cameras import ring_rig
            >>> predictor = Predictor(ring_rig(4), method="semi_global", level=4, min_depth=0.5)
            >>> predictor.with_rig(ring_rig(3))
            Predictor(RefinedSweepNet, from 0.5 m, CameraRig(cam1, cam2, cam3: 3 x FisheyeCamera, radius 0.200 m))
        """
        check_single(rig)
        check_number(self._net, rig)
        if self._min_depth is not None:
            with self._lock:
                self._network()
        return self._with(_rig=rig.to(self._device), _ready=None)

    def with_min_depth(self, metres: float) -> Predictor:
        """The same with another nearest hypothesis; the network's weights are shared.

        Args:
            metres: of the nearest hypothesis.

        Raises:
            ArgumentError: no positive number.
        """
        return self._with(_min_depth=checked_min_depth(metres), _ready=None, _scaled=None)

    def find_min_depth(self, frames: Iterable[Mapping[str, Any]]) -> float:
        """Find the nearest depth in metres worth trying in a few frames, and use it from now on.

        With ``min_depth="auto"`` that is the depth of the training where the scene is not far nearer or farther.

        Args:
            frames: of images by camera name, as the predictor is called with, one frame each.
        """
        photographs = [self._photographs(images) for images in frames]
        with self._lock:
            self._min_depth = self._nearest.in_frames(photographs, self._rig, self._antialias)
            self._ready = self._scaled = None
            return self._min_depth

    def prepare(self, frames: Iterable[Mapping[str, Any]]) -> RigTurns | None:
        """Do with a few frames what ``preparation`` says is done once: cameras that are turned are turned back.

        Args:
            frames: of images by camera name, as the predictor is called with, one frame each.

        Returns:
            The verdict on the calibration, whatever it is; None where it is not asked for.
        """
        if not self.preparation.align:
            return None
        found = self.judge(frames)
        self._use(found)
        return found

    def align(self, frames: Iterable[Mapping[str, Any]]) -> RigTurns | None:
        """Turn cameras whose images disagree at the depth that the network estimates, and use that rig from now on.

        Calibrations are seldom right for long: orientations wrong by a degree double the error of depth. They are found
        to about a tenth of a degree, from one frame or a few. Cameras whose turn does not clearly exceed its
        uncertainty are left alone. Positions and intrinsics are not touched.

        Args:
            frames: as of ``judge``.

        Returns:
            The turned rig, its turns, and how well images agreed before and after; None if the rig stays as it is.
        """
        found = self.judge(frames)
        self._use(found)
        return found if found.turned else None

    def judge(self, frames: Iterable[Mapping[str, Any]]) -> RigTurns:
        """Say whether cameras are turned from what the calibration says, from images at the depth estimated.

        Args:
            frames: of images by camera name, as the predictor is called with, one frame each; a second or two each.

        Returns:
            The verdict: turns and their uncertainty, which cameras are turned, or why nothing could be told.
        """
        if len(self._rig) < 2:
            return untold(self._rig, "one camera has nothing to be compared with")
        kept = list(frames)
        if not kept:
            return untold(self._rig, "there is no frame")

        def estimated(rig: CameraRig) -> list[Depth]:
            predictor = self if rig is self._rig else self.with_rig(rig)
            return [predictor(images) for images in kept]

        return judged_rig(estimated(self._rig), estimated)

    @torch.inference_mode()
    def __call__(self, images: Mapping[str, Any]) -> Depth:
        """Estimate depth.

        Args:
            images: camera name -> image: numpy or torch, ``(h, w)``, ``(h, w, 3)`` or ``(3, h, w)`` or a batch of them,
                uint8, uint16 or float in [0, 1], of the size that the camera is calibrated for.

        Raises:
            ArgumentError: images of other cameras, or values out of range.
            ShapeError: an image has another size than its camera.
        """
        photographs = self._photographs(images)
        ready = self._prepared(photographs)
        batch = photographs[self._rig.names[0]].shape[:-3]
        inputs, taken_out = self._inputs(ready, photographs)
        with self._turn():
            estimate = ready.net.predict(
                inputs.reshape(-1, *inputs.shape[len(batch) :]), ready.tables, ready.intake.seen
            )
        index, confidence, seen = (values.reshape(*batch, *values.shape[1:]) for values in estimate)
        return Depth(index.float(), confidence.float(), seen, ready.net, self._rig, photographs, taken_out)

    def inputs(
        self, images: Mapping[str, Any]
    ) -> tuple[Float[Tensor, "*batch_and_size"], Bool[Tensor, " n *size"]]:
        """Return images as the network takes them, in [-1, 1], and what of them was seen; arguments as of a call."""
        photographs = self._photographs(images)
        ready = self._prepared(photographs)
        return self._inputs(ready, photographs)[0], ready.intake.seen

    def _use(self, found: RigTurns) -> None:
        if found.turned:
            with self._lock:
                self._rig, self._ready = found.rig, None

    def __repr__(self) -> str:
        near = (
            "nearest depth still to be found" if self._min_depth is None else f"from {self._min_depth:.3g} m"
        )
        return f"Predictor({type(self._net).__name__}, {near}, {self._rig})"

    def _with(self, **changes: Any) -> Predictor:
        """A copy with changes, which takes turns with this one: they compute with the same network."""
        other = copy.copy(self)
        vars(other).update(changes, _lock=self._lock)
        return other

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in vars(self).items() if name != "_lock"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state, _lock=threading.Lock())

    def _turn(self) -> AbstractContextManager[Any]:
        """Wait for one's turn, where two calls at once would take more cores than there are."""
        room = 2 * torch.get_num_threads() <= (os.cpu_count() or 1)
        return nullcontext() if room and self._device.type == "cpu" else self._lock

    def _photographs(self, images: Mapping[str, Any]) -> dict[str, Tensor]:
        found = as_photographs(images, self._rig, self._channels)
        return {name: image.to(self._device, non_blocking=True) for name, image in found.items()}

    @full_precision
    def _inputs(
        self, ready: _Ready, photographs: Mapping[str, Tensor]
    ) -> tuple[Tensor, tuple[Compensation, ...]]:
        """``(*b, n, 3, V)`` on icospheres, or ``(*b, n, 3, h, w)``, 0 where nothing was seen; what was taken out."""
        if self.preparation.of_images is None:
            return ready.intake(photographs), ()
        compensator = ready.compensator
        bright, gains = compensator.brightened(photographs)
        smooth, noise = compensator.smoothed(bright)
        flat = {name: image.reshape(-1, *image.shape[-3:]) for name, image in smooth.items()}
        frames = [{name: images[frame] for name, images in flat.items()} for frame in range(len(noise))]
        lights = [compensator.light(frame) if len(self._rig) > 1 else None for frame in frames]
        taken_out = tuple(map(Compensation, noise, lights, gains))
        if ready.net.images == "camera":
            even = [compensator.evened(frame, light) for frame, light in zip(frames, lights, strict=True)]
            stacked = {n: torch.stack([frame[n] for frame in even]).view_as(smooth[n]) for n in smooth}
            return ready.intake(stacked), taken_out
        values = ready.intake.looked_up(smooth)
        for frame, light in zip(values.view(-1, *values.shape[-3:]), lights, strict=True):
            if light is not None:
                frame.div_(light.light(ready.angles)).clamp_(0, 1)
        return signed(values, ready.intake.seen), taken_out

    def _ready_now(self) -> _Ready:
        if self._ready is None and self._min_depth is None:
            raise ArgumentError(
                "network: min_depth is found in the first images; call the predictor or its find_min_depth"
            )
        return self._prepared(None)

    def _prepared(self, photographs: Mapping[str, Tensor] | None) -> _Ready:
        """Network and tables, made by the first call; others wait for it."""
        ready = self._ready
        if ready is not None:
            return ready
        with self._lock:
            if self._ready is None:
                if self._min_depth is None and photographs is not None:
                    self._min_depth = self._nearest.in_frames(
                        frames_of(photographs), self._rig, self._antialias
                    )
                self._ready = self._made()
            return self._ready

    def _network(self) -> DepthNetwork:
        """The network with the hypotheses that were asked for, where it is to compute; made once."""
        if self._scaled is not None:
            return self._scaled
        number = self._num_hypotheses
        net = self._net.with_changes(min_depth=self._min_depth)
        if self._method == "semi_global":  # one level coarser than the images
            level = self._level or (net.level if net.images == "sphere" else SCENE_LEVEL - 1)
            net = SemiGlobalSweep(level, number or net.num_hypotheses, net.min_depth, depth_coarsening=1)
        elif number is not None:
            net = net.with_changes(num_hypotheses=number)
        self._scaled = net.eval().to(self._device)
        return self._scaled

    @full_precision
    @torch.inference_mode(False)  # what is kept must be usable where gradients are wanted
    def _made(self) -> _Ready:
        net = self._network()
        intake, angles = net.intake(self._rig, self._antialias), torch.empty(0)
        if net.images == "sphere":
            vertices = icosphere_vertices(net.level, torch.float32, self._device).to(
                self._rig.world_from_camera
            )
            angles = angle_from_axis(vertices @ self._rig.world_from_camera[:, :3, :3]).float()
        return _Ready(net, net.tables(self._rig), intake, Compensator(self._rig), angles)


def check_number(net: DepthNetwork, rig: CameraRig) -> None:
    """Raise ``ArgumentError`` if a network is for another number of cameras than a rig has."""
    if len(rig) != net.num_cameras and not net.any_cameras:
        raise ArgumentError(
            f"rig: it has {len(rig)} cameras ({', '.join(rig.names)}), the checkpoint is for {net.num_cameras}; "
            f"choose {net.num_cameras} of them (rig.subset([...]), cameras=[...] of the command), or "
            f"train a network with model.num_cameras={len(rig)}"
        )


def frames_of(photographs: Mapping[str, Tensor]) -> list[dict[str, Tensor]]:
    """One dictionary a frame of images ``(*b, 3, h, w)``: the first, the middle and the last of a batch."""
    first = next(iter(photographs.values()))
    if first.ndim == 3:
        return [dict(photographs)]
    chosen = sorted({0, len(first) // 2, len(first) - 1})
    return [{name: image[frame] for name, image in photographs.items()} for frame in chosen]


def checked_device(device: torch.device | str) -> torch.device:
    """Return a device of this machine, or raise ``ArgumentError`` with those that there are.

    Examples:
        >>> checked_device("cpu")
        device(type='cpu')
    """
    try:
        return torch.empty(0, device=device).device
    except (RuntimeError, AssertionError, TypeError):
        there = "'cpu' or 'cuda'" if torch.cuda.is_available() else "'cpu', the only one of this machine"
        raise ArgumentError(f"device: expected {there}, got {device!r}") from None
