# SPDX-License-Identifier: Apache-2.0
"""A network with the tables of a rig inside, as a program that runs without this package: torch.export and ONNX."""

from __future__ import annotations

import json
import logging
import tempfile
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Bool, Float, Shaped
from torch import Tensor, nn
from torch.func import functional_call
from torch.utils import _pytree

from sphericalvision.capture.constant_folding import with_constants_folded
from sphericalvision.capture.pipeline import in_precision
from sphericalvision.capture.predictor import Predictor
from sphericalvision.capture.result import positive
from sphericalvision.core import ArgumentError, MissingCompilerError, check_choice
from sphericalvision.io.files import atomic_write, write_bytes
from sphericalvision.kernels import kernels
from sphericalvision.sphere import Equirectangular
from sphericalvision.sphere.intake import signed
from sphericalvision.sweep import inverse_depth_from_index

INPUTS = ("camera", "sphere")
OUTPUTS = ("inverse_depth", "confidence", "seen")
TABLES = ("inside", "inputs")
OPSET = 18
"""Of ONNX. From 20 on GridSample says "linear", which TensorRT does not know, and it samples the nearest pixel."""
DESCRIPTION = "description"
"""Under which an exported program keeps that of its inputs and outputs."""


class RigProgram(nn.Module):
    """A network and a rig as a module of tensors alone, which can be exported.

    Args:
        predictor: whose nearest depth is known; the program is for its device, and computes in its precision.
        inputs: ``"camera"`` for images ``(B, n, 3, h, w)`` in [0, 1] as the cameras take them, or ``"sphere"`` for
            ``(B, n, 3, V)`` in [-1, 1] on icospheres, as ``Predictor.inputs`` makes them.
        height: rows of a panorama that the answer is given on; on the network's own grid when not given.
        tables: ``"inside"``, the rig is a part of the program; or ``"inputs"``, it is called with images and
            ``rig_tables``, those of this rig or of another one with as many cameras.

    Raises:
        ArgumentError: the images of the cameras differ in size, or the network does not take images on icospheres.

    Examples:
        >>> from sphericalvision.cameras import ring_rig
        >>> predictor = Predictor(ring_rig(3, image_size=(16, 16)), method="semi_global", level=3, min_depth=0.5)
        >>> program = RigProgram(predictor, height=8)
        >>> inverse_depth, confidence, seen = program(torch.rand(1, 3, 3, 16, 16))
        >>> inverse_depth.shape
        torch.Size([1, 8, 16])
    """

    seen: Tensor
    rays: Tensor

    def __init__(
        self, predictor: Predictor, inputs: str = "camera", height: int | None = None, tables: str = "inside"
    ) -> None:
        super().__init__()
        check_choice("inputs", inputs, INPUTS)
        check_choice("tables", tables, TABLES)
        self.net, self.inputs, self.tables = predictor.network, inputs, tables
        self.shape: tuple[int, int] | None = None
        self.intake, self.precision = predictor.pipeline.intake, predictor.pipeline.precision
        if inputs == "sphere" and self.net.images != "sphere":
            raise ArgumentError(
                f"inputs: {type(self.net).__name__} takes images of cameras, not of icospheres"
            )
        sizes = sorted({camera.image_size for camera in predictor.rig.cameras.values()})
        if inputs == "camera" and len(sizes) > 1:
            raise ArgumentError(
                f"inputs: expected cameras with images of one size, got {sizes}; export inputs=sphere"
            )
        self.image_size, self.num_cameras = sizes[0], len(predictor.rig)
        # So that their tables are of this module.
        self.places = nn.ModuleList(look.places for look in self.intake.lookups if inputs == "camera")
        self.register_buffer("seen", self.intake.seen)
        leaves, self.structure = _pytree.tree_flatten(predictor.pipeline.tables)
        self.leaves = [None if isinstance(leaf, Tensor) else leaf for leaf in leaves]
        for number, leaf in enumerate(leaves):
            if isinstance(leaf, Tensor):
                self.register_buffer(f"table{number}", leaf.contiguous())
        if height is not None:
            view = Equirectangular(height, 2 * height, device=self.seen.device)
            self.shape = view.shape
            self.register_buffer("rays", view.directions.reshape(-1, 3).clone())

    def forward(
        self, images: Float[Tensor, "B n 3 *size"], tables: dict[str, Tensor] | None = None
    ) -> tuple[Float[Tensor, " B *grid"], Float[Tensor, " B *grid"], Bool[Tensor, " B *grid"]]:
        """Return inverse depth in 1/m, confidence, and what two cameras saw, ``(B, *grid)`` each.

        Args:
            images: as ``inputs`` has them.
            tables: of ``rig_tables``, in the place of those inside.
        """
        if tables is not None:
            return functional_call(self, tables, (images,))  # type: ignore[no-any-return]
        if self.inputs == "camera":
            named = dict(zip(self.intake.rig.names, images.unbind(1), strict=True))
            images = signed(self.intake.looked_up(self.intake.averaged(named)), self.seen)
        leaves = [getattr(self, f"table{k}") if leaf is None else leaf for k, leaf in enumerate(self.leaves)]
        rig = _pytree.tree_unflatten(leaves, self.structure)
        with in_precision(self.precision, images.device):
            index, confidence, seen = self.net.predict(images, rig, self.seen)
        confidence = confidence.float()
        inverse_depth = inverse_depth_from_index(index.float(), self.net.num_hypotheses, self.net.min_depth)
        if self.shape is None:
            return inverse_depth, confidence, seen
        shape = (images.shape[0], *self.shape)
        together = torch.stack((inverse_depth, confidence, seen.to(inverse_depth))).flatten(0, 1)
        values, reached = self.net.index_at(together, self.rays)
        inverse_depth, confidence, seen_by_two = values.unflatten(0, (3, -1)).unbind()
        inverse_depth = positive(inverse_depth).where(reached, float("nan"))
        seen = (seen_by_two > 0.5) & reached
        return inverse_depth.view(shape), confidence.view(shape), seen.view(shape)


def description(program: RigProgram) -> dict[str, str]:
    """Return what somebody has to know who has the program alone: what goes in and comes out, in which order and units.

    It is written beside the ``.pt2`` file as ``.json``, and stands in the metadata of the ONNX file.

    Examples:
        >>> from sphericalvision.cameras import ring_rig
        >>> predictor = Predictor(ring_rig(3, image_size=(16, 16)), method="semi_global", level=3, min_depth=0.5)
        >>> description(RigProgram(predictor, height=8))["cameras"]
        'cam1, cam2, cam3'
    """
    rig, net = program.intake.rig, program.net
    size = "x".join(map(str, program.image_size))
    images = {
        "camera": f"as the cameras take them, height x width {size}, red, green and blue in [0, 1], not in [0, 255]",
        "sphere": "on the vertices of an icosphere, red, green and blue in [-1, 1], 0 where nothing was seen",
    }
    if program.shape is not None:
        grid = "equirectangular panorama: forward is its middle column, columns grow to the right, the top row is up"
    else:
        grid = f"{net.grid!r}, in the order of its directions"
    return {
        "images": f"float32 (batch, {len(rig)} cameras in this order, 3, ...): {images[program.inputs]}",
        "cameras": ", ".join(rig.names),
        "inverse_depth": "float32, 1/m, along the ray from the center; its reciprocal is metres; NaN: not known",
        "confidence": "float32, 0 to 1",
        "seen": "bool, True where two cameras look; elsewhere depth is a guess",
        "grid": grid,
        "axes": "x right, y down, z forward, metres, in the world of the calibration",
        "center": ", ".join(f"{round(value, 6):.13g}" for value in rig.in_world().center.tolist()),
        "min_depth": f"{net.min_depth:.6g}",
        "num_hypotheses": str(net.num_hypotheses),
        "device": program.seen.device.type,
        "precision": f"{program.precision}; inputs, geometry and outputs are float32",
    }


def rig_tables(program: RigProgram, like: RigProgram | None = None) -> dict[str, Shaped[Tensor, " ..."]]:
    """Return by name all that a program knows of its rig: the inputs, besides images, of one with ``tables="inputs"``.

    Args:
        program: of a rig.
        like: the program that is to be called with these tables; they are checked to fit.

    Raises:
        ArgumentError: that program was made for other sizes: number of cameras, level, or size of the images.

    Examples:
        >>> from sphericalvision.cameras import ring_rig
        >>> def program(radius, tables="inside"):
        ...     rig = ring_rig(3, radius=radius, image_size=(16, 16))
        ...     return RigProgram(Predictor(rig, method="semi_global", level=3, min_depth=0.5), "sphere", None, tables)
        >>> one, other = program(0.2, "inputs"), program(0.1)
        >>> images = example_images(one)
        >>> torch.equal(one(images, rig_tables(other, like=one))[0], other(images)[0])
        True
    """
    tables = {name: x for name, x in program.named_buffers() if not name.startswith(("net.", "rays"))}
    if like is not None:
        layout, expected = (_layout(one) for one in (program, like))
        if layout != expected:
            name = next(name for name in {**expected, **layout} if layout.get(name) != expected.get(name))
            raise ArgumentError(
                f"program: its table {name} is {layout.get(name)}, expected {expected.get(name)}; programs share "
                "tables of as many cameras, images of one size, about the same angle a pixel, and one level"
            )
    return tables


def _layout(program: RigProgram) -> dict[str, str]:
    layout = {name: f"{table.dtype} {tuple(table.shape)}" for name, table in rig_tables(program).items()}
    lookups = program.intake.lookups if program.inputs == "camera" else []
    return layout | {f"shrinking of camera {k}": str(look.shrink) for k, look in enumerate(lookups)}


def example_images(program: RigProgram, batch: int = 1) -> Float[Tensor, "B n 3 *size"]:
    """Return random images of the shape and range that a program takes."""
    size = program.image_size if program.inputs == "camera" else program.seen.shape[1:]
    images = torch.rand(batch, program.num_cameras, 3, *size, device=program.seen.device)
    return images if program.inputs == "camera" else signed(images)


@contextmanager
def quiet() -> Iterator[None]:
    """Keep off the screen what torch and its converters tell of themselves; errors are raised as ever."""
    before = logging.root.manager.disable
    logging.disable(logging.WARNING)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        logging.disable(before)


@torch.no_grad()
def export_program(
    program: RigProgram, path: str | Path | None = None, batch: int | None = 1
) -> torch.export.ExportedProgram:
    """Return a program as ``torch.export`` has it, and write it to a ``.pt2`` file, which torch runs by itself.

    Beside the file, ``.json`` in place of ``.pt2``, stands its ``description``.

    All that follows from level and rig is computed now and is constant in the program.

    Args:
        program: what to export.
        path: of the file; none is written when not given.
        batch: B of the images, or None for a program that takes any number of them.

    Examples:
        >>> from sphericalvision.cameras import ring_rig
        >>> predictor = Predictor(ring_rig(3, image_size=(16, 16)), method="semi_global", level=3, min_depth=0.5)
        >>> program = RigProgram(predictor, "sphere")
        >>> images = example_images(program)
        >>> torch.allclose(export_program(program).module()(images)[0], program(images)[0], atol=1e-5)
        True
    """
    inputs: tuple[Any, ...] = (example_images(program.eval(), batch or 2),)
    shapes: tuple[Any, ...] = ({} if batch else {0: torch.export.Dim("batch", min=1)},)
    if program.tables == "inputs":
        tables = rig_tables(program)
        inputs, shapes = (*inputs, tables), (*shapes, dict.fromkeys(tables))
    with quiet(), kernels("graph"):
        # Makes the tables of icospheres: who records would take the making for a part of the program
        program(*inputs)
        traced: Any = torch.export.export(program, inputs, dynamic_shapes=shapes, strict=False)
        if program.precision != "float32":  # what autocast does to each operator is written out
            traced = traced.run_decompositions({})
        folded = with_constants_folded(traced.module(), *inputs)
        exported = torch.export.export(folded, inputs, dynamic_shapes=shapes, strict=False)
        exported.graph_module.meta[DESCRIPTION] = description(program)
        # Of the images a file needs the shape, and of what is computed not the lines of Python that it is from.
        exported.example_inputs = _pytree.tree_map(lambda x: x.new_zeros(()).expand(x.shape), (inputs, {}))
        for node in exported.graph.nodes:
            node.meta = {"val": node.meta.get("val")}
        if path is not None:
            with atomic_write(path) as temporary:
                torch.export.save(exported, temporary)
            _write_description(exported, Path(path))
    return exported


def compile_program(exported: torch.export.ExportedProgram, path: str | Path) -> Path:
    """Compile an exported program to machine code, which libtorch runs from C++ and torch from Python.

    The ``.pt2`` file is for the device of the program, this kind of processor and this version of torch:
    ``torch._inductor.aoti_load_package`` in Python, ``AOTIModelPackageLoader`` in C++.

    Args:
        exported: of ``export_program``.
        path: of the file, which ends in ``.pt2``.

    Raises:
        ArgumentError: another ending.
        MissingCompilerError: there is no C++ compiler on this machine or, for a CUDA device, no Triton or toolkit.
    """
    from torch._inductor import aoti_compile_and_package
    from torch._inductor.exc import InvalidCxxCompiler, TritonMissing

    path = Path(path)
    if path.suffix != ".pt2":
        raise ArgumentError(f"path: expected a name that ends in .pt2, got {path.name!r}")
    with tempfile.TemporaryDirectory(dir=path.parent) as folder, quiet():
        try:
            package = aoti_compile_and_package(exported, package_path=str(Path(folder) / path.name))
        except InvalidCxxCompiler:
            raise MissingCompilerError(
                "compiled: needs a C++ compiler, g++ or clang++ (CXX names another); formats=[pt2,onnx] need none"
            ) from None
        except (TritonMissing, OSError) as error:
            if isinstance(error, OSError) and "CUDA_HOME" not in str(error):
                raise
            raise MissingCompilerError(
                "compiled: for device=cuda needs Triton (pip install triton), and the CUDA toolkit and its headers; "
                "CUDA_HOME names its folder"
            ) from None
        Path(package).replace(path)
    _write_description(exported, path)
    return path


def _write_description(exported: torch.export.ExportedProgram, path: Path) -> None:
    content = exported.graph_module.meta.get(DESCRIPTION, {})
    write_bytes(path.with_suffix(".json"), json.dumps(content, indent=2).encode())


def export_onnx(exported: torch.export.ExportedProgram, path: str | Path) -> Path:
    """Write an exported program as an ONNX file with the outputs of ``RigProgram``.

    Its inputs are ``images`` and, where the program has them, the tables: ``rig.`` and their names.

    Raises:
        ArgumentError: the packages for it are missing.
    """
    try:
        import onnx  # noqa: F401
        from onnx_ir.passes import PassManager, common
        from onnxscript import opset18
        from onnxscript.optimizer import fold_constants
    except ImportError as error:
        raise ArgumentError(f"onnx: needs {error.name}: pip install onnx onnxscript onnxruntime") from None

    # The converter's own take two and three nodes.
    def select_rows(values: Any, dim: int, index: Any) -> Any:
        return opset18.Gather(values, index, axis=dim)

    def unbind(values: Any, dim: int = 0) -> Any:
        return [opset18.Gather(values, number, axis=dim) for number in range(values.shape[dim])]

    inputs, _ = exported.example_inputs
    with quiet(), atomic_write(path) as temporary:
        # The optimiser of the converter does not end on programs of this size; folding does, and is half of the nodes.
        converted = torch.onnx.export(
            exported,
            dynamo=True,
            optimize=False,
            verbose=False,
            opset_version=OPSET,
            custom_translation_table={
                torch.ops.aten.index_select.default: select_rows,
                torch.ops.aten.unbind.int: unbind,
            },
            input_names=["images", *(f"rig.{name}" for tables in inputs[1:] for name in tables)],
            output_names=OUTPUTS,
        )
        assert converted is not None
        fold_constants(converted.model)  # axes and shapes, which TensorRT wants as constants
        # Folding leaves what it folded, once for each use, and each node says which line of Python it is from.
        PassManager(
            [
                common.RemoveUnusedNodesPass(),
                common.LiftConstantsToInitializersPass(lift_all_constants=True, size_limit=0),
                common.DeduplicateInitializersPass(size_limit=1 << 30),  # of 1,024 numbers by itself
                common.CommonSubexpressionEliminationPass(),
                common.ClearMetadataAndDocStringPass(),
                common.RemoveUnusedNodesPass(),
            ]
        )(converted.model)
        converted.model.metadata_props.update(exported.graph_module.meta.get(DESCRIPTION, {}))
        converted.save(temporary)
    return Path(path)


def onnx_difference(path: str | Path, program: RigProgram, images: Float[Tensor, "B n 3 *size"]) -> float:
    """Return by how much the inverse depth of an ONNX file by onnxruntime differs from a program's at most, in 1/m."""
    import onnxruntime

    session = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
    tables = rig_tables(program) if program.tables == "inputs" else {}
    inputs = {"images": images, **{f"rig.{name}": table for name, table in tables.items()}}
    arrays = {node.name: inputs[node.name].cpu().numpy() for node in session.get_inputs()}
    result = torch.from_numpy(session.run(["inverse_depth"], arrays)[0])
    with torch.no_grad():
        expected = program(images)[0].cpu()
    return float((result - expected).nan_to_num().abs().max())
