# SPDX-License-Identifier: Apache-2.0
"""Every reader of files, with a small file that it reads; `tests/test_generated_files.py` damages them."""

import tempfile
import warnings
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
import yaml

from sphericalvision.cameras import (
    CameraRig,
    FisheyeCamera,
    convert,
    read_cameras,
    read_rig,
    read_trajectory,
    ring_rig,
    save_camera,
    save_rig,
)
from sphericalvision.capture.hint_files import HintFiles
from sphericalvision.capture.sources.frames import Selection
from sphericalvision.capture.sources.opening import open_source
from sphericalvision.data import read_points
from sphericalvision.data.omnistereo.ground_truth import read_ground_truth, write_ground_truth
from sphericalvision.data.omnistereo.releases import read_min_depth
from sphericalvision.io.images import read_image, read_mask, read_pages, write_mask
from sphericalvision.models import (
    IcoSweepNet,
    SphereClassifier,
    load_reference_checkpoint,
    load_weights,
    save_weights,
)
from sphericalvision.models.weights.checkpoints import read_network
from sphericalvision.recipes.digits.module import ClassificationModule
from sphericalvision.recipes.training.run_folder import stored_network
from sphericalvision.scenes import read_mesh_scene
from sphericalvision.scenes.cache import ArrayCache
from sphericalvision.sphere import Equirectangular
from tests.cameras.calibration_samples import RIGHT_OF_FIRST, TEXTS, flat, read_everything, sample
from tests.data.test_truth import write_pcd
from tests.models.test_weights import in_reference_names
from tests.recipes.tiny import write_streams

__all__ = ["READERS", "Reader", "files"]

Read = Callable[[Path], Any]


class Reader(NamedTuple):
    """Reads a file of a folder of `files`.

    Attributes:
        folder: name of the folder.
        file: the one that is damaged; what lies beside it stays as it is.
        read: gets the path of the file.
    """

    folder: str
    file: str
    read: Read


def both(*readers: Read) -> Read:
    def read(path: Path) -> None:
        for reader in readers:
            reader(path)

    return read


def of_folder(path: Path) -> None:
    read_cameras(path.parent, max_angle=1.0)
    read_rig(path.parent, max_angle=1.0)


def ocam_folder(path: Path) -> None:
    read_rig(path.parent, translation_unit="m")


def vins(path: Path) -> None:
    read_rig(path.with_name("estimator.yaml"), max_angle=1.0)


def cached(path: Path) -> None:
    """A cache never refuses: what is damaged is made anew, and then is whole."""
    cache = ArrayCache(path.parent, {"depth": ((2,), torch.float32)})
    assert cache.get(path.stem, lambda: {"depth": torch.ones(2)})["depth"].shape == (2,)


def frames(path: Path) -> None:
    """A source says of a frame why it cannot be read."""
    for frame in open_source(str(path), SMALL).frames(Selection(), lambda _: True):
        if frame.error is not None:
            raise frame.error


def hint(path: Path) -> None:
    HintFiles(str(path), ["0"], SMALL, torch.eye(4))("0")


SMALL = ring_rig(2, image_size=(16, 32))
IMAGE = both(read_image, read_mask)
TRUTH = partial(read_ground_truth, min_depth=0.55)
READERS = {
    **{name: Reader("texts", name, read_everything) for name in TEXTS},
    "rig.yaml": Reader("own", "rig.yaml", read_everything),
    "mask.png": Reader("own", "mask.png", lambda path: read_rig(path.with_name("rig.yaml"))),
    "ocam1.txt": Reader("ocam", "ocam1.txt", both(read_cameras, ocam_folder)),
    "poses.txt": Reader("ocam", "poses.txt", ocam_folder),
    "config.yaml": Reader("omnimvs", "config.yaml", both(read_everything, read_min_depth)),
    "estimator.yaml": Reader("vins", "estimator.yaml", vins),
    "cam1_mei.yaml": Reader("vins", "cam1_mei.yaml", vins),
    **{
        f"colmap/{part}.{suffix}": Reader(suffix, f"{part}.{suffix}", of_folder)
        for suffix in ("bin", "txt")
        for part in ("cameras", "rigs")
    },
    **{
        f"colmap/images.{suffix}": Reader(f"{suffix}_without_rigs", f"images.{suffix}", of_folder)
        for suffix in ("bin", "txt")
    },
    "tum.txt": Reader("ways", "tum.txt", read_trajectory),
    "kitti.txt": Reader("ways", "kitti.txt", read_trajectory),
    "way/images.txt": Reader("txt", "images.txt", read_trajectory),
    "way/images.bin": Reader("bin", "images.bin", read_trajectory),
    "depth.png": Reader("truth", "depth.png", TRUTH),
    "depth.tiff": Reader("truth", "depth.tiff", TRUTH),
    "two.tiff": Reader("truth", "two.tiff", TRUTH),
    **{
        f"image.{suffix}": Reader("images", f"image.{suffix}", IMAGE)
        for suffix in ("png", "jpg", "tiff", "bmp", "webp", "gif", "ppm", "jp2", "sr")
    },
    "image.hdr": Reader("images", "image.hdr", read_pages),
    "image16.png": Reader("images", "image16.png", IMAGE),
    **{
        f"mesh.{suffix}": Reader("meshes", f"mesh.{suffix}", read_mesh_scene)
        for suffix in ("glb", "gltf", "obj", "ply", "stl", "off")
    },
    "net.safetensors": Reader("weights", "net.safetensors", load_weights),
    "net.ckpt": Reader("weights", "net.ckpt", both(read_network, stored_network)),
    "net.pth": Reader("weights", "net.pth", load_reference_checkpoint),
    "digits.ckpt": Reader("weights", "digits.ckpt", ClassificationModule.stored_network),
    "scene.npz": Reader("cache", "scene.npz", cached),
    **{f"run.{suffix}": Reader("bags", f"run.{suffix}", frames) for suffix in ("bag", "mcap", "db3")},
    **{f"two.{suffix}": Reader("videos", f"two.{suffix}", frames) for suffix in ("mp4", "mkv")},
    **{
        f"scan.{suffix}": Reader("points", f"scan.{suffix}", read_points)
        for suffix in ("pcd", "bin", "ply", "npy", "csv", "xyz")
    },
    **{f"hint.{suffix}": Reader("hints", f"hint.{suffix}", hint) for suffix in ("npz", "npy", "png", "ply")},
}


@cache
def files(folder: str) -> dict[str, bytes]:
    """Names and contents of the files of one folder of samples."""
    with tempfile.TemporaryDirectory() as place, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        globals()[f"write_{folder}"](Path(place))
        return {path.name: path.read_bytes() for path in Path(place).iterdir() if path.is_file()}


def write_texts(folder: Path) -> None:
    for name, text in TEXTS.items():
        (folder / name).write_text(text)


def write_own(folder: Path) -> None:
    rig = ring_rig(2, image_size=(48, 64))
    save_rig(rig, folder / "rig.yaml")
    content = yaml.safe_load((folder / "rig.yaml").read_text())
    content["cameras"][0]["mask"] = "mask.png"
    (folder / "rig.yaml").write_text(yaml.safe_dump(content))
    write_mask(folder / "mask.png", torch.ones(48, 64, dtype=torch.bool))


def ocam_rig() -> CameraRig:
    rig = ring_rig(2, image_size=(48, 64))
    cameras = {name: convert(camera, to="ocam").camera for name, camera in rig.cameras.items()}
    return CameraRig(cameras, rig.world_from_camera)


def write_ocam(folder: Path) -> None:
    for number, camera in enumerate(ocam_rig().cameras.values(), start=1):
        save_camera(camera, folder / f"ocam{number}.txt", format="ocamcalib")
    (folder / "poses.txt").write_text("0 0 0 0 0 0\n0 1.5 0 0.2 0 0\n")


def write_omnimvs(folder: Path) -> None:
    save_rig(ocam_rig(), folder / "config.yaml", format="omnimvs")
    content = yaml.safe_load((folder / "config.yaml").read_text())
    content["config"] = {"omnimvs_sweep_min_depth": 0.55}
    (folder / "config.yaml").write_text(yaml.safe_dump(content))


def write_vins(folder: Path) -> None:
    estimator: dict[str, Any] = {"num_of_cam": 2}
    for number, pose in enumerate((np.eye(4), RIGHT_OF_FIRST)):
        estimator |= {f"cam{number}_calib": f"cam{number}_mei.yaml", f"body_T_cam{number}": flat(pose)}
        (folder / f"cam{number}_mei.yaml").write_text(yaml.safe_dump(sample("image_02.yaml")))
    (folder / "estimator.yaml").write_text(yaml.safe_dump(estimator))


def colmap_rig() -> CameraRig:
    lenses = (
        convert(FisheyeCamera.from_field_of_view((48, 64), 1.0), to=model).camera
        for model in ("kannala_brandt", "extended_unified")
    )
    return CameraRig(list(lenses), ring_rig(2).world_from_camera)


def write_bin(folder: Path) -> None:
    save_rig(colmap_rig(), folder / "cameras.bin", "colmap")


def write_txt(folder: Path) -> None:
    save_rig(colmap_rig(), folder / "cameras.txt", "colmap")


def write_bin_without_rigs(folder: Path) -> None:
    """As older versions write it; beside rigs nothing is read of images."""
    write_bin(folder)
    (folder / "rigs.bin").unlink()
    (folder / "frames.bin").unlink()


def write_txt_without_rigs(folder: Path) -> None:
    write_txt(folder)
    (folder / "rigs.txt").unlink()
    (folder / "frames.txt").unlink()


def write_ways(folder: Path) -> None:
    (folder / "tum.txt").write_text("# time x y z\n1.5 0 0 0 0 0 0 1\n1.6 0.1 0 0 0.6 0 0 0.8\n")
    (folder / "kitti.txt").write_text("1 0 0 0.5 0 1 0 0 0 0 1 0\n0 0 1 0.7 0 1 0 0 -1 0 0 2e-1\n")


def write_truth(folder: Path) -> None:
    depth = torch.linspace(0, 1.5, 512).reshape(16, 32)
    write_ground_truth(folder / "depth.png", depth, 0.55)
    write_ground_truth(folder / "depth.tiff", depth, 0.55)
    pages = [np.zeros((16, 32, 3), dtype=np.uint8), depth.numpy()]
    cv2.imwritemulti(str(folder / "two.tiff"), pages)


def write_images(folder: Path) -> None:
    pixels = np.linspace(0, 255, 32 * 32 * 3, dtype=np.uint8).reshape(32, 32, 3)
    for suffix in ("png", "jpg", "tiff", "bmp", "webp", "gif", "ppm", "jp2", "sr"):
        cv2.imwrite(str(folder / f"image.{suffix}"), pixels)
    cv2.imwrite(str(folder / "image.hdr"), pixels.astype(np.float32))
    cv2.imwrite(str(folder / "image16.png"), pixels.astype(np.uint16) * 200)


def write_meshes(folder: Path) -> None:
    import trimesh

    box = trimesh.creation.box((4.0, 3.0, 6.0))
    for suffix in ("glb", "obj", "ply", "stl", "off"):
        box.export(folder / f"mesh.{suffix}")
    content = box.export(file_type="gltf")
    for name, part in content.items():
        (folder / name.replace("model.gltf", "mesh.gltf")).write_bytes(part)


def write_weights(folder: Path) -> None:
    net = IcoSweepNet(3, 4, feature_channels=2)
    save_weights(net, folder / "net.safetensors")
    named = {"architecture": "icosweepnet", "network_hyperparameters": net.hyperparameters}
    state = {f"net.{name}": value for name, value in net.state_dict().items()}
    others = {"optimizer_states": [], "lr_schedulers": [], "loops": {}, "global_step": 1}
    torch.save({**named, "state_dict": state, **others}, folder / "net.ckpt")
    scale = {"ndisp": 4, "min_depth": 0.3, "level": 3}
    torch.save({"state_dict": in_reference_names(net), **scale}, folder / "net.pth")
    digits = SphereClassifier("hex", 3, width=2)
    state = {f"net.{name}": value for name, value in digits.state_dict().items()}
    torch.save(
        {"network_hyperparameters": digits.hyperparameters, "state_dict": state}, folder / "digits.ckpt"
    )


def write_bags(folder: Path) -> None:
    from tests.capture.bags import write_bag  # skips where rosbags is not installed

    picture = np.zeros((16, 32, 3), np.uint8)
    messages = [(f"/{name}/image", time, time, picture) for time in (1, 2) for name in SMALL.names]
    write_bag(folder / "run.bag", messages, storage="bag")
    for storage in ("mcap", "db3"):
        write_bag(folder / storage, messages, storage=storage)
        next((folder / storage).glob(f"*.{storage}")).rename(folder / f"run.{storage}")


def write_videos(folder: Path) -> None:
    picture = np.zeros((16, 32, 3), np.uint8)
    for suffix, codec in (("mp4", "mpeg4"), ("mkv", "ffv1")):
        write_streams(folder / f"two.{suffix}", [[picture] * 3] * 2, codec)


def write_points(folder: Path) -> None:
    import trimesh

    points = np.linspace(-2, 2, 24, dtype=np.float32).reshape(8, 3)
    write_pcd(folder / "scan.pcd", points, "ascii")
    np.hstack((points, points[:, :1])).tofile(folder / "scan.bin")
    np.save(folder / "scan.npy", points)
    trimesh.PointCloud(points).export(folder / "scan.ply")
    np.savetxt(folder / "scan.csv", points, delimiter=",", header="x,y,z")
    np.savetxt(folder / "scan.xyz", points)


def write_hints(folder: Path) -> None:
    write_points(folder)
    (folder / "scan.ply").rename(folder / "hint.ply")
    panorama = Equirectangular(8, 16)
    np.savez(
        folder / "hint.npz",
        directions=panorama.directions.numpy(),
        inverse_depth=np.ones((8, 16), np.float32),
        confidence=np.ones((8, 16), np.float32),
    )
    np.save(folder / "hint.npy", np.ones((16, 32), np.float32))
    cv2.imwrite(str(folder / "hint.png"), np.full((8, 16), 2000, np.uint16))


def write_cache(folder: Path) -> None:
    np.savez_compressed(folder / "scene.npz", depth=np.zeros(2, dtype=np.float32))
