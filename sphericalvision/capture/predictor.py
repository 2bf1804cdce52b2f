# SPDX-License-Identifier: Apache-2.0
"""``Predictor``: a rig and a network in one thing that is called with images and answers with depth."""

from __future__ import annotations

import copy
import os
import pickle
import threading
import warnings
from collections.abc import Iterable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, nullcontext
from multiprocessing.reduction import ForkingPickler
from pathlib import Path
from typing import Any, Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sphericalvision.cameras import CameraRig
from sphericalvision.cameras.base import check_single
from sphericalvision.capture.pipeline import PRECISIONS, Pipeline
from sphericalvision.capture.preparation.nearest import (
    SCENE_LEVEL,
    NearestHypothesis,
    check_places,
    checked_min_depth,
    frames_of,
    nearest_hypothesis,
)
from sphericalvision.capture.preparation.preparation import Preparation
from sphericalvision.capture.result import Depth
from sphericalvision.core import ArgumentError, check_choice, check_tensor, check_type
from sphericalvision.geometry.directions import holds
from sphericalvision.icosphere import Icosphere
from sphericalvision.icosphere.topology import check_level
from sphericalvision.models import DepthNetwork
from sphericalvision.models.weights.checkpoints import read_network
from sphericalvision.sphere import Equirectangular
from sphericalvision.sphere.intake import as_colors, ordered_images
from sphericalvision.sweep import DepthHint
from sphericalvision.threads import available_cores

METHODS = ("network", "semi_global")
HARDLY = 0.5
"""Trust of a network in a hint below which a warning says so: at 0 the hint is not used at all."""


class Colors(Mapping[str, Tensor]):
    """Camera name -> ``(*b, 3, h, w)`` in [0, 1], of bytes or floats that become it when somebody first asks."""

    def __init__(self, images: Mapping[str, Tensor]) -> None:
        self._images = dict(images)
        self._colors: dict[str, Tensor] = {}

    def __getitem__(self, name: str) -> Tensor:
        if name not in self._colors:
            self._colors[name] = as_colors(self._images[name])
        return self._colors[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._images)

    def __len__(self) -> int:
        return len(self._images)


@contextmanager
def no_more_threads_than_cores() -> Iterator[None]:
    """Limit torch to the cores that the process may use.

    It counts the cores of the machine, not the quota of a container: threads without a core are waited for at the end
    of each loop, thousands of times a frame. A number that is set in the environment stays.
    """
    threads, cores = torch.get_num_threads(), available_cores()
    if threads <= cores or "OMP_NUM_THREADS" in os.environ:
        yield
        return
    with threads_kept():
        torch.set_num_threads(cores)
        yield


@contextmanager
def threads_kept() -> Iterator[int]:
    """Give back to torch the number of threads that it has here, whatever threads within ask for; yields it."""
    count = torch.get_num_threads()
    try:
        yield count
    finally:
        torch.set_num_threads(count)


class Predictor:
    """Depth all around from the images of a rig.

    All tables of the rig are computed once. Calls may come from several threads. On a CPU they run in parallel if
    torch leaves them cores: ``torch.set_num_threads(1)`` in each thread gives the most frames per second. If each call
    uses more than half of the cores, and on a GPU, calls wait for each other. Copies and pickles are predictors of
    their own, with the tables as far as these are made.

    Args:
        rig: calibrated cameras, for instance ``cameras.read_rig("capture/config.yaml")``; its masks are used.
        weights: a name of ``models.available_weights()``, a weights file, or a network; by default the one that
            ships, ``refinedsweepnet``. ``pretrained().with_changes(num_hypotheses=32)`` has other hypotheses.
        method: ``"network"``, or ``"semi_global"``: a sweep without training at the level of the network.
        min_depth: nearest hypothesis in metres. ``"scene"`` estimates it from the first images, once, which takes one
            to three seconds. ``None`` is that of the training, scaled with the rig if the network was trained with rigs
            of one radius (``net.min_depth_follows``). ``"auto"`` is that, too, unless the network was trained with rigs
            of many radii and the first images show a scene four times nearer or farther; without training it is
            ``"scene"``.
        level: icosphere level of the images; by default that of the training, 6 if no weights are given. One level
            less is three times as fast.
        device: where to compute; by default the device of the network, which is the CPU if it was read from weights.
        preparation: how images are preprocessed before depth is estimated, ``Preparation()`` when not given: noise is
            smoothed, light compensated. ``align_rig`` finds out whether cameras are turned, from a few frames.
        precision: that the network computes in; geometry, light and noise, and the mean over hypotheses are float32.
            Less is faster on a GPU, and hardly less exact.

    Attributes:
        rig: the cameras, on the device.
        device: where depth is computed.
        preparation: as given.
        min_depth: nearest hypothesis in metres; None as long as it has not been found in images.

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
        device: torch.device | str | None = None,
        preparation: Preparation | None = None,
        precision: Literal["float32", "bfloat16", "float16"] = "float32",
    ) -> None:
        check_type("rig", rig, CameraRig, "ring_rig makes one, read_rig reads one")
        check_single(rig)
        check_choice("method", method, METHODS)
        check_choice("precision", precision, PRECISIONS)
        if level is not None:
            check_level(level)
        net = weights if isinstance(weights, DepthNetwork) else read_network(weights)
        check_number(net, rig)
        if len(rig) < 2 and (method == "semi_global" or net.num_cameras > 1):
            raise ArgumentError(
                f"rig: expected two or more cameras, got {len(rig)} ({', '.join(rig.names)}): "
                "depth is what they see differently; add a camera (cameras=[...] of the command)"
            )
        if len(rig) > 1:
            check_places(rig)
        self._nearest: NearestHypothesis = nearest_hypothesis(min_depth, net, rig, method == "network")
        self.min_depth = self._nearest.metres
        self.device = net.device if device is None else checked_device(device)
        self.rig = rig.to(self.device)
        self.preparation = Preparation() if preparation is None else preparation
        self._precision = precision
        nearest = net.min_depth if self.min_depth is None else self.min_depth
        if method == "semi_global":  # one level coarser than the images
            from sphericalvision.models import SemiGlobalSweep

            level = level or (net.level if net.images == "sphere" else SCENE_LEVEL - 1)
            net = SemiGlobalSweep(level, net.num_hypotheses, nearest, depth_coarsening=1)
        else:
            net = with_own(net, net is weights, level=level, min_depth=nearest)
        self._network = net.eval().to(self.device)
        self._lock = threading.Lock()
        self._pipeline: Pipeline | None = None

    @property
    def network(self) -> DepthNetwork:
        """The network at the scale of the rig.

        Raises:
            ArgumentError: the scale is not known before the first images came (``min_depth="auto"`` or ``"scene"``).
        """
        return self.pipeline.network

    @property
    def pipeline(self) -> Pipeline:
        """What is made once for the rig: the network, its tables, and what makes images into those that it takes.

        Raises:
            ArgumentError: as ``network``.
        """
        if self.min_depth is None:
            raise ArgumentError(
                "network: min_depth is found in the first images; call the predictor, or give metres (with_changes)"
            )
        return self._pipeline_for(None)

    def with_changes(self, rig: CameraRig | None = None, *, min_depth: float | None = None) -> Predictor:
        """The same for another rig, such as the next window of a camera that moves, or with other hypotheses.

        The network's weights are shared as long as hypotheses stay as they are; tables are computed again.

        Args:
            rig: of any number of cameras, if the network takes that; as before when not given.
            min_depth: metres of the nearest hypothesis; as before when not given.

        Raises:
            ArgumentError: the network is for another number of cameras, or the depth is no positive number.

        Examples:
            >>> from sphericalvision.cameras import ring_rig
            >>> predictor = Predictor(ring_rig(4), method="semi_global", level=4, min_depth=0.5)
            >>> predictor.with_changes(ring_rig(3))
            Predictor(SemiGlobalSweep, from 0.5 m, CameraRig(cam1, cam2, cam3: 3 x FisheyeCamera, radius 0.200 m))
        """
        other = copy.copy(self)
        # They take turns, since they compute with the same network.
        other._lock, other._pipeline = self._lock, None
        if rig is not None:
            check_single(rig)
            check_number(self._network, rig)
            other.rig = rig.to(self.device)
        if min_depth is not None:
            other._begin_at(checked_min_depth(min_depth))
        return other

    def nearest_depth(self, frames: Iterable[Mapping[str, Any]]) -> float:
        """Return the nearest hypothesis in metres that suits what a few frames show; ``with_changes`` takes it.

        With ``min_depth="auto"`` that is the depth of the training where the scene is not far nearer or farther.

        Args:
            frames: of images by camera name, as the predictor is called with, one frame each.
        """
        return self._nearest.in_frames([Colors(self._on_device(images)) for images in frames], self.rig)

    @no_more_threads_than_cores()
    @torch.inference_mode()
    def __call__(self, images: Mapping[str, Any], hint: DepthHint | None = None) -> Depth:
        """Estimate depth.

        Args:
            images: camera name -> image: numpy or torch, ``(h, w)``, ``(h, w, 3)`` or ``(3, h, w)`` or a batch of them,
                uint8, uint16 or float in [0, 1], of the size that the camera is calibrated for.
            hint: depth that is known beforehand, ``(B, V)`` at the vertices of ``grid``; ``Hint.on`` makes it.

        Raises:
            ArgumentError: images of other cameras, or values out of range; a hint for a network that takes none.
            ShapeError: an image has another size than its camera.
        """
        ordered = self._on_device(images)
        colors = Colors(ordered)
        pipeline = self._pipeline_for(colors)
        checked = None if hint is None else self._checked(hint)
        with self._turn(), self._enough_memory():
            if pipeline.on_cuda:  # bytes go into the graph
                frame = pipeline(ordered, self.preparation, checked)
            else:  # what is made of them is at hand for the result
                frame = pipeline(colors, self.preparation, checked)
        if frame.trust is not None and (trust := float(frame.trust.min())) < HARDLY:
            warnings.warn(
                f"hint: it disagrees with what the images show, and counts with {trust:.2f} of its weight; is it of "
                "another frame, or in another unit?",
                stacklevel=2,
            )
        return Depth(*frame.estimate, pipeline.network, self.rig, colors, frame.corrections)

    @property
    def grid(self) -> Icosphere | Equirectangular:
        """The directions of depth, where hints have their values."""
        return self._network.grid

    def check_takes_hints(self) -> None:
        """Raise ``ArgumentError`` if the network takes no hints."""
        self._network.check_takes_hints()

    def _checked(self, hint: DepthHint) -> DepthHint:
        """A hint on the device."""
        self.check_takes_hints()
        check_type("hint", hint, DepthHint, "hint.on(predictor.grid, predictor.rig) makes one")
        for name, values in zip(("inverse_depth", "weight"), hint, strict=True):
            check_tensor(f"hint.{name}", values, "(B, V)")
        result = DepthHint(*(values.to(self.device, torch.float32) for values in hint))
        inverse_depth, weight = result
        valid = (inverse_depth >= 0) & inverse_depth.isfinite() & (weight > 0) & (weight <= 1)
        if inverse_depth.shape == weight.shape and not holds((weight == 0) | valid):
            raise ArgumentError(
                "hint: expected weights from 0 to 1 and, where they are above 0, inverse depth in 1/m of 0 or more"
            )
        return result

    def inputs(
        self, images: Mapping[str, Any]
    ) -> tuple[Float[Tensor, "*batch_and_size"], Bool[Tensor, " n *size"]]:
        """Return images as the network takes them, in [-1, 1], and what of them was seen; arguments as of a call."""
        colors = Colors(self._on_device(images))
        pipeline = self._pipeline_for(colors)
        return pipeline.inputs(colors, self.preparation)[0], pipeline.intake.seen

    def __repr__(self) -> str:
        start = (
            "nearest depth still to be found" if self.min_depth is None else f"from {self.min_depth:.3g} m"
        )
        return f"Predictor({type(self._network).__name__}, {start}, {self.rig})"

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in vars(self).items() if name != "_lock"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state, _lock=threading.Lock())

    def _turn(self) -> AbstractContextManager[Any]:
        """Wait for one's turn, where two calls at once would take more cores than the process may use."""
        room = 2 * torch.get_num_threads() <= available_cores()
        return nullcontext() if room and self.device.type == "cpu" else self._lock

    def _on_device(self, images: Mapping[str, Any]) -> dict[str, Tensor]:
        """Images in the order of the cameras; bytes travel as bytes, one image while the next one is preprocessed."""
        ordered = ordered_images(images, self.rig)
        # From pinned memory, which torch keeps and takes again once it is read
        if self.device.type == "cuda":
            ordered = {name: image.pin_memory() if image.is_cpu else image for name, image in ordered.items()}
        return {name: image.to(self.device, non_blocking=True) for name, image in ordered.items()}

    @contextmanager
    def _enough_memory(self) -> Iterator[None]:
        """Raise ``ArgumentError`` with what would help, where the device has not enough memory."""
        if self.device.type == "cuda":
            torch.cuda.reset_peak_memory_stats(self.device)
        try:
            yield
        except torch.OutOfMemoryError as error:
            peak = torch.cuda.max_memory_allocated(self.device) / 2**30
            free, total = (size / 2**30 for size in torch.cuda.mem_get_info(self.device))
            level = getattr(self._network, "level", None)
            less = "" if level is None else f"; level={level - 1} needs about a quarter of it"
            raise ArgumentError(
                f"device: a frame needs more than {peak:.1f} GiB of {self.device}, which has {total:.1f} GiB, "
                f"{free:.1f} GiB of them free{less}"
            ) from error

    def _begin_at(self, metres: float) -> None:
        """Use the hypotheses from a depth on."""
        self.min_depth = metres
        self._network = with_own(self._network, False, min_depth=metres)

    def _pipeline_for(self, colors: Mapping[str, Tensor] | None) -> Pipeline:
        """What is made once, by the first call, which may have to look at its images; others wait for it."""
        pipeline = self._pipeline
        if pipeline is not None:
            return pipeline
        with self._lock:
            if self._pipeline is None:
                if self.min_depth is None and colors is not None:
                    self._begin_at(self._nearest.in_frames(frames_of(colors), self.rig))
                # Its loops are many and short: threads of them would wait for each other longer than they compute.
                with threads_kept():
                    torch.set_num_threads(1)
                    self._pipeline = Pipeline(self._network, self.rig, self._precision)
            return self._pipeline


def with_own(net: DepthNetwork, copied: bool, **changes: Any) -> DepthNetwork:
    """Return a network with hyper-parameters changed: itself where none differs, unless it is to be a copy.

    Networks are constructed for that, all changes at once.
    """
    present = net.hyperparameters
    same = all(
        value is None or (name in present and present[name] == value) for name, value in changes.items()
    )
    return net if same and not copied else net.with_changes(**changes)


def check_number(net: DepthNetwork, rig: CameraRig) -> None:
    """Raise ``ArgumentError`` if a network is for another number of cameras than a rig has."""
    if len(rig) != net.num_cameras and not net.any_cameras:
        raise ArgumentError(
            f"rig: it has {len(rig)} cameras ({', '.join(rig.names)}), the checkpoint is for {net.num_cameras}; "
            f"choose {net.num_cameras} of them (rig.subset([...]), cameras=[...] of the command), or "
            f"train a network with model.num_cameras={len(rig)}"
        )


def checked_device(device: torch.device | str) -> torch.device:
    """Return a device of this machine, or raise ``ArgumentError`` with those that there are.

    Examples:
        >>> checked_device("cpu")
        device(type='cpu')
    """
    try:
        return torch.empty(0, device=device).device
    except (RuntimeError, AssertionError, TypeError) as error:
        choices = "'cpu' or 'cuda'" if torch.cuda.is_available() else "'cpu', the only one of this machine"
        reason = f"; torch says: {str(error).partition('. ')[0]}" if "driver" in str(error) else ""
        raise ArgumentError(f"device: expected {choices}, got {device!r}{reason}") from None


def _by_value(predictor: Predictor) -> tuple[Any, tuple[bytes]]:
    """How a predictor travels to another process: torch sends a file for each tensor, and a fork server takes 253."""
    return pickle.loads, (pickle.dumps(predictor),)


ForkingPickler.register(Predictor, _by_value)
