# SPDX-License-Identifier: Apache-2.0
"""The program in C++ of the documentation: it is built, reads PNGs, and writes the depth that ``Predictor`` finds."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from sphericalvision import Predictor
from sphericalvision.cameras import ring_rig
from sphericalvision.capture.export import RigProgram, compile_program, export_program
from sphericalvision.io.images import write_image
from sphericalvision.models import IcoSweepNet
from sphericalvision.scenes import make_scene, render_rig

SOURCE = Path(__file__).parents[2] / "docs" / "cpp" / "depth.cpp"


@pytest.fixture(scope="module")
def program(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The program, built by g++ as CMake would with the torch that is installed."""
    if shutil.which("g++") is None:
        pytest.skip("no g++")
    torch_root, built = Path(torch.__file__).parent, tmp_path_factory.mktemp("cpp") / "depth"
    folders = [torch_root / "include", torch_root / "include/torch/csrc/api/include"]
    libraries = ["-ltorch", "-ltorch_cpu", "-lc10", "-lpng", f"-Wl,-rpath,{torch_root / 'lib'}"]
    includes = [f"-I{folder}" for folder in folders]
    command = ["g++", "-std=c++20", str(SOURCE), *includes, f"-L{torch_root / 'lib'}", "-Wl,--no-as-needed"]
    done = subprocess.run([*command, *libraries, "-o", built], capture_output=True, text=True, check=False)
    if "png.h: No such file" in done.stderr or "cannot find -lpng" in done.stderr:
        pytest.skip("no libpng")
    assert done.returncode == 0, done.stderr
    return built


@pytest.mark.slow
def test_depth_of_pngs(program: Path, tmp_path: Path) -> None:
    torch.manual_seed(0)
    rig = ring_rig(3, image_size=(32, 40))
    net = IcoSweepNet(3, 8, feature_channels=2, num_cameras=3, norm="instance", aggregation="variance")
    predictor = Predictor(rig, net.eval(), min_depth=0.5)
    exported = export_program(RigProgram(predictor, height=12))
    package = compile_program(exported, tmp_path / "depth.compiled.pt2")
    images, paths = render_rig(make_scene("room", seed=1), rig), []
    for name, image in images.items():
        paths.append(tmp_path / f"{name}.png")
        write_image(paths[-1], image)
    done = subprocess.run(
        [program, package, tmp_path / "depth.png", *paths], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert "24 x 12" in done.stdout
    millimetres = cv2.imread(str(tmp_path / "depth.png"), cv2.IMREAD_UNCHANGED)
    assert millimetres.dtype == np.uint16
    read = {name: (image * 255).round() / 255 for name, image in images.items()}
    panorama = predictor(read).panorama(12)
    expected = torch.where(panorama.seen, panorama.depth * 1000, 0.0).clamp(max=65535)
    torch.testing.assert_close(
        torch.from_numpy(millimetres.astype(np.float32)), expected.nan_to_num(65535), rtol=1e-3, atol=1.0
    )

    small = tmp_path / "small.png"
    write_image(small, torch.rand(3, 8, 8))
    for words, told in (
        ([package], "usage"),
        ([package, "depth.png", paths[0], small, small], "expected 40 x 32"),
        ([package, "depth.png", *paths[:2], tmp_path / "none.png"], "none.png"),
        ([tmp_path / "none.pt2", "depth.png", *paths], ""),
    ):
        done = subprocess.run([program, *words], capture_output=True, text=True, check=False, cwd=tmp_path)
        assert done.returncode in (1, 2)
        assert told in done.stderr
