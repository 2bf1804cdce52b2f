# SPDX-License-Identifier: Apache-2.0
"""``DepthNetwork``: the interface of depth networks for training, evaluation, prediction and files."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from itertools import chain
from typing import TYPE_CHECKING, Any, ClassVar, Literal, Self

import torch
from jaxtyping import Bool, Float, Num
from torch import Tensor, nn

from sphericalvision.core import ArgumentError, ShapeError, check_counts, check_dtype
from sphericalvision.crown import set_kernel_options
from sphericalvision.crown.recompute import recomputes
from sphericalvision.icosphere import Icosphere, num_icosphere_vertices
from sphericalvision.shapes import check_shapes
from sphericalvision.sphere.intake import Intake
from sphericalvision.sweep import DepthEstimate, DepthHint, depth_from_index
from sphericalvision.sweep.depth_hint import check_hint
from sphericalvision.sweep.hypotheses import check_hypotheses

if TYPE_CHECKING:
    from sphericalvision.cameras import CameraRig
    from sphericalvision.sphere import Equirectangular


class RemembersArguments(nn.Module):
    """A module that keeps the arguments of its constructor.

    Examples:
        >>> class Scaled(RemembersArguments):
        ...     def __init__(self, factor, *, offset=0.0):
        ...         super().__init__()
        >>> Scaled(2).hyperparameters
        {'factor': 2, 'offset': 0.0}
        >>> Scaled(2)
        Scaled(factor=2, offset=0.0)
    """

    _arguments: dict[str, Any]

    def __new__(cls, *args: Any, **kwargs: Any) -> Self:
        """Note the constructor's arguments, before the constructors of the class and its bases run."""
        net = super().__new__(cls)
        try:
            bound = inspect.signature(cls.__init__).bind(net, *args, **kwargs)
        except TypeError:  # of a copy, which gets its arguments with its state; or __init__ will raise
            return net
        bound.apply_defaults()
        arguments = dict(list(bound.arguments.items())[1:])
        for name, parameter in inspect.signature(cls.__init__).parameters.items():
            if parameter.kind is inspect.Parameter.VAR_KEYWORD:
                arguments |= arguments.pop(name)
            elif parameter.kind is inspect.Parameter.VAR_POSITIONAL and (nameless := arguments.pop(name)):
                arguments[f"*{name}"] = nameless
        object.__setattr__(net, "_arguments", arguments)
        return net

    @property
    def hyperparameters(self) -> dict[str, Any]:
        """Arguments of the constructor as plain values: ``type(net)(**net.hyperparameters)`` builds the network again.

        Raises:
            ArgumentError: an argument is no plain value, or has no name.
        """
        return {name: _plain(name, value) for name, value in self._arguments.items()}

    def extra_repr(self) -> str:
        return ", ".join(f"{name}={value}" for name, value in self._arguments.items())


def _plain(name: str, value: Any) -> Any:
    """The value of a hyper-parameter as a file can hold it."""
    if name.startswith("*"):
        raise ArgumentError(
            f"{name}: expected arguments with names, by which files hold them, got {value!r} without; pass them as "
            f"name=value, or take a list, {name[1:]}, in place of {name}"
        )
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, Mapping):
        return {str(key): _plain(name, item) for key, item in value.items()}
    if isinstance(value, Sequence):
        return [_plain(name, item) for item in value]
    raise ArgumentError(
        f"{name}: expected plain values (numbers, text, None, lists of them), which files can hold, "
        f"got {type(value).__name__}"
    )


class DepthNetwork(RemembersArguments):
    """Base of networks that estimate depth around a rig, as hypothesis indices on a grid of directions.

    A subclass declares the images it takes in ``images``, sets ``grid``, and implements ``predict``, or ``_estimate``,
    which ``predict`` calls with checked arguments. All other methods follow from these, and may be overridden.

    Convention:
        Images are in [-1, 1], in the order of ``rig.names``. ``seen`` is True where they show something; it is the
        fields of view less masks when not given. The result is a hypothesis index seen from ``rig.center``, in
        directions of the world: 0 is infinity, N - 1 is ``min_depth``; ``depth`` turns it into metres along the ray.
        Arguments of the constructor are plain values (numbers, texts, None, lists of them).

    Args:
        num_hypotheses: N, two or more.
        min_depth: radius of the nearest hypothesis in metres.
        num_cameras: number of cameras of the rigs.
        any_cameras: whether rigs of any number of cameras, in any order, are taken.

    Attributes:
        images: ``"sphere"`` for images ``(B, n, 3, V_level)`` on icospheres aligned with the world, or ``"camera"`` for
            images ``(B, n, 3, H, W)`` as the cameras took them.
        grid: of the result, an ``Icosphere`` or a panorama.
        level: of the icospheres that hold the images; only where ``images`` is ``"sphere"``.
        image_channels: numbers of channels that images may have.
        min_depth_follows: the nearest hypothesis in use: ``"rig"``, that of the training times the ratio of the rig's
            radius to ``trained_radius``, for networks trained with rigs of one radius; ``"training"``, that of the
            training, if rigs of many radii were in it; ``"scene"``, a little nearer than the nearest surface, for
            methods without training.
        trained_radius: radius of the rigs of the training in metres.
        bounds: largest integers of hyper-parameters in files of weights, by name; the usual ones without.
        takes_hints: whether ``predict`` and ``training_loss`` take a ``DepthHint``; others refuse one.

    Raises:
        ArgumentError: fewer than two hypotheses or less than one camera, or a depth that is not positive.

    Examples:
        A network whose depth is the same everywhere, and is learned:

        >>> from torch import nn
        >>> from sphericalvision.cameras import ring_rig
        >>> from sphericalvision.icosphere import Icosphere
        >>> class Constant(DepthNetwork):
        ...     def __init__(self, level=3, num_hypotheses=8, min_depth=0.5):
        ...         super().__init__(num_hypotheses, min_depth, num_cameras=1, any_cameras=True)
        ...         self.level, self.grid = level, Icosphere(level)
        ...         self.index = nn.Parameter(torch.tensor(3.0))
        ...     def predict(self, images, rig, seen=None):
        ...         index = self.index.expand(len(images), *self.grid.shape)
        ...         return DepthEstimate(index, torch.ones_like(index), torch.ones_like(index, dtype=torch.bool))
        >>> net = Constant(level=2)
        >>> net(torch.zeros(1, 4, 3, 162), ring_rig(4)).shape
        torch.Size([1, 162])
        >>> net.with_changes(level=3)
        Constant(
          level=3, num_hypotheses=8, min_depth=0.5
          (grid): Icosphere(level=3, vertices=642, faces=1280)
        )
    """

    images: ClassVar[Literal["sphere", "camera"]] = "sphere"
    grid: Icosphere | Equirectangular
    level: int
    image_channels: tuple[int, ...] = (3,)
    min_depth_follows: ClassVar[Literal["rig", "training", "scene"]] = "rig"
    trained_radius: float = 0.2
    bounds: ClassVar[Mapping[str, int]] = {}
    takes_hints: ClassVar[bool] = False

    def __init__(
        self, num_hypotheses: int, min_depth: float, num_cameras: int, any_cameras: bool = False
    ) -> None:
        super().__init__()
        check_hypotheses(num_hypotheses, min_depth)
        check_counts(num_cameras=num_cameras)
        self.num_hypotheses, self.min_depth = num_hypotheses, min_depth
        self.num_cameras, self.any_cameras = num_cameras, any_cameras

    def predict(
        self,
        images: Float[Tensor, "B n C *size"],
        rig: CameraRig | Any,
        seen: Bool[Tensor, "B n *size"] | Bool[Tensor, " n *size"] | None = None,
        hint: DepthHint | None = None,
    ) -> DepthEstimate:
        """Return the hypothesis index, the confidence in it, and whether two cameras saw it, each ``(B, *grid.shape)``.

        Args:
            images: ``(B, n, 3, V_level)`` on icospheres or ``(B, n, 3, H, W)`` of cameras, as ``self.images`` says.
            rig: of all samples or, with batched poses, a rig a sample; or the ``tables`` of either.
            seen: ``([B,] n, V_level)`` or ``([B,] n, H, W)``, True where the images show something.
            hint: ``(B, *grid.shape)``, known depth; only where the network ``takes_hints``.

        Raises:
            ArgumentError: a hint for a network that takes none.
            ShapeError: if the images have another shape than the network or the rig asks for.
        """
        self.check_images(images, seen, hint)
        return self._estimate(images, rig, seen, hint)

    def predict_with_trust(
        self,
        images: Float[Tensor, "B n C *size"],
        rig: CameraRig | Any,
        seen: Bool[Tensor, "B n *size"] | Bool[Tensor, " n *size"] | None,
        hint: DepthHint,
    ) -> tuple[DepthEstimate, Float[Tensor, "B one"] | None]:
        """Return the result of ``predict``, and the trust in the hint, ``(B, 1)`` from 0 to 1; None if all are trusted.

        Arguments and errors are those of ``predict``.
        """
        if type(self).predict is not DepthNetwork.predict:  # of others, who may change the images
            return self.predict(images, rig, seen, hint), None
        self.check_images(images, seen, hint)
        return self._estimate_and_trust(images, rig, seen, hint)

    def _estimate(
        self, images: Tensor, rig: CameraRig | Any, seen: Tensor | None, hint: DepthHint | None
    ) -> DepthEstimate:
        """Compute the result of ``predict``; images, ``seen`` and hint have the right shapes."""
        raise NotImplementedError(f"{type(self).__name__}._estimate")

    def _estimate_and_trust(
        self, images: Tensor, rig: CameraRig | Any, seen: Tensor | None, hint: DepthHint | None
    ) -> tuple[DepthEstimate, Tensor | None]:
        """Compute the result of ``predict_with_trust``."""
        return self._estimate(images, rig, seen, hint), None

    def forward(
        self,
        images: Float[Tensor, "B n C *size"],
        rig: CameraRig | Any,
        seen: Bool[Tensor, "B n *size"] | Bool[Tensor, " n *size"] | None = None,
        hint: DepthHint | None = None,
    ) -> Float[Tensor, " B *grid"]:
        """Return the hypothesis index ``(B, *grid.shape)``, 0 to N - 1; arguments as for ``predict``."""
        hints = () if hint is None else (hint,)  # ``predict`` of other packages' networks may take no hint
        return self.predict(images, rig, seen, *hints).index

    def training_loss(
        self,
        images: Float[Tensor, "B n C *size"],
        rig: CameraRig | Any,
        seen: Bool[Tensor, "B n *size"] | Bool[Tensor, " n *size"] | None,
        target: Float[Tensor, " B *grid"],
        valid: Bool[Tensor, " B *grid"],
        loss: Callable[..., Tensor],
        hint: DepthHint | None = None,
    ) -> Float[Tensor, ""]:
        """Return the loss that training minimises: that of the index, unless a network adds others.

        It is the mean of the samples' losses, each with its own rig.

        Args:
            images: as for ``predict``; so are ``rig``, ``seen`` and ``hint``.
            target: the true index.
            valid: where it is known.
            loss: of index, true index and where that is known.
        """
        hints = () if hint is None else (hint,)  # as in ``forward``
        return loss(self(images, rig, seen, *hints), target, valid)

    def intake(self, rig: CameraRig, antialias: bool = True) -> Intake:
        """Return the ``Intake`` that turns the images of a rig's cameras into those that this network takes.

        Args:
            rig: unbatched.
            antialias: whether images finer than the icosphere are averaged over the area between its vertices.

        Raises:
            ShapeError: the network takes images of cameras, and their sizes differ.
        """
        return Intake(rig, Icosphere(self.image_level) if self.images == "sphere" else None, antialias)

    def tables(self, rig: CameraRig) -> Any:
        """Return tables of a rig, computed once, which may be passed in its place."""
        return rig

    @check_shapes
    def check_images(
        self,
        images: Float[Tensor, "B n C *size"],
        seen: Bool[Tensor, "B n *size"] | Bool[Tensor, " n *size"] | None = None,
        hint: DepthHint | None = None,
    ) -> None:
        """Raise ``ShapeError`` unless images, ``seen`` and hint have the shape and the cameras that this network takes.

        A hint for a network that takes none is an ``ArgumentError``.
        """
        weight = next((value for value in self.parameters() if value.is_floating_point()), None)
        if weight is not None:
            check_dtype("images", images, weight)
        levels = sorted({self.level, self.image_level}) if self.images == "sphere" else []
        counts = [num_icosphere_vertices(level) for level in levels]
        if (
            images.ndim != (4 if counts else 5)
            or (counts and images.shape[3] not in counts)
            or images.shape[2] not in self.image_channels
            or (images.shape[1] != self.num_cameras and not self.any_cameras)
        ):
            cameras = "n" if self.any_cameras else self.num_cameras
            channels = " or ".join(map(str, self.image_channels))
            last = " or ".join(map(str, counts)) or "H, W"
            where = f" on icospheres of level {' or '.join(map(str, levels))}" if levels else ""
            raise ShapeError(
                f"images: expected shape (B, {cameras}, {channels}, {last}) for {cameras} cameras{where}, "
                f"got {tuple(images.shape)}"
            )
        if hint is not None:
            self.check_takes_hints()
            check_hint(hint, (images.shape[0], *self.grid.shape))

    def check_takes_hints(self) -> None:
        """Raise ``ArgumentError`` if this network takes no hints."""
        if not self.takes_hints:
            raise ArgumentError(
                f"hint: {type(self).__name__} takes none; leave it out, or take RefinedSweepNet"
            )

    @property
    def image_level(self) -> int:
        """Level of the finest images that this network uses, and that ``intake`` makes; it also takes ``level``."""
        return self.level

    @property
    def depth_level(self) -> int | None:
        """Level of the icosphere on which the result lies; None where it lies on a panorama."""
        return self.grid.level if isinstance(self.grid, Icosphere) else None

    def depth(self, index: Num[Tensor, "*grid"]) -> Float[Tensor, "*grid"]:
        """Return depths in metres of hypothesis indices ``(*)``."""
        return depth_from_index(index, self.num_hypotheses, self.min_depth)

    def index_at(
        self, index: Float[Tensor, " B *grid"], directions: Float[Tensor, "V 3"]
    ) -> tuple[Float[Tensor, "B V"], Bool[Tensor, " V"]]:
        """Return the index ``(B, V)`` in other directions of the world, and whether the grid holds them ``(V,)``.

        Args:
            index: ``(B, *grid.shape)`` as ``forward`` returns it; linear between the grid's points.
            directions: ``(V, 3)``.
        """
        directions = directions.to(index.device)
        values = self.grid.sample(index.unsqueeze(1), directions).squeeze(1)
        contains = getattr(self.grid, "contains", None)  # a panorama may end before the poles
        if contains is not None:
            return values, contains(directions)
        return values, torch.ones(len(directions), dtype=torch.bool, device=index.device)

    @property
    def device(self) -> torch.device:
        """Device of the weights."""
        return next(chain(self.parameters(), self.buffers())).device

    def with_changes(self, **changes: Any) -> Self:
        """Return a network with a copy of the weights and other hyper-parameters; ``None`` leaves one as it is.

        Raises:
            ArgumentError: this network has no such hyper-parameter, or the shapes of its weights depend on it.

        Examples:
            >>> from sphericalvision.models import pretrained
            >>> net = pretrained()
            >>> net.level, net.with_changes(level=5, min_depth=0.2).level
            (6, 5)
        """
        before = self.hyperparameters
        changes = {name: value for name, value in changes.items() if value is not None}
        for name in changes:
            if name not in before:
                raise ArgumentError(
                    f"{name}: {type(self).__name__} has no such hyper-parameter, leave it out; "
                    f"it has {', '.join(before)}"
                )
        net = type(self)(**{**before, **changes})
        state, expected = self.state_dict(), net.state_dict()
        for name, tensor in expected.items():
            if name not in state or state[name].shape != tensor.shape:
                raise ArgumentError(
                    f"{', '.join(changes)}: cannot be changed after training, the weights of {type(self).__name__} "
                    f"depend on it ('{name}')"
                )
        net.load_state_dict(state)
        like = next(chain(self.parameters(), self.buffers()), None)
        if like is not None:
            net.to(device=like.device, dtype=like.dtype if like.is_floating_point() else None)
        if recomputes(self):
            net.configure(recompute=True)
        return net.train(self.training)

    def at_level(self, level: int) -> Self:
        """Return a network for images on another icosphere that shares the weights of this one.

        Training either changes both, until one of them is moved or cast.

        Args:
            level: of the images.

        Raises:
            ArgumentError: this network has no such hyper-parameter, or its weights depend on it.

        Examples:
            >>> from sphericalvision.models import pretrained
            >>> net = pretrained()
            >>> coarser = net.at_level(5)
            >>> coarser.level, next(coarser.parameters()) is next(net.parameters())
            (5, True)
        """
        net = self.with_changes(level=level)
        for name, part in net.named_modules():
            own = self.get_submodule(name)
            part._parameters = own._parameters
            part._buffers |= {
                key: buffer
                for key, buffer in own._buffers.items()
                if key not in own._non_persistent_buffers_set
            }
        return net

    def configure(self, recompute: bool) -> Self:
        """Choose whether training computes the inside of blocks twice: less memory, a third more work, same results.

        Returns the network.

        Raises:
            ArgumentError: if no part of this network has such a choice.
        """
        set_kernel_options(self, recompute=recompute)
        return self

    @property
    def recompute(self) -> bool:
        """Whether training computes the inside of blocks twice; see ``configure``."""
        return recomputes(self)
