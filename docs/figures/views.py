# SPDX-License-Identifier: Apache-2.0
"""Figures of images: views of a panorama, resampling modes, scenes of the renderer."""

from __future__ import annotations

import functools
import math

import torch
from skimage.data import brick

from figures import bar_below, bare_axes, new_figure, to_html
from sphericalvision.cameras import (
    EquirectangularCamera,
    FisheyeCamera,
    PinholeCamera,
    remap,
)
from sphericalvision.scenes import make_scene, ray_depth, render_camera
from sphericalvision.scenes.registry import scene_kinds
from sphericalvision.sphere import Equirectangular, resample, views
from sphericalvision.viz import depth_to_color
from sphericalvision.viz.color import depth_ticks

__all__ = ["panorama_views", "resampling_modes", "scenes"]

YAWS = (0, 90, 180, 270)
NEAR = 0.55  # metres, red


def panorama_views() -> str:
    """A panorama, a fisheye and pinhole views cut from it."""
    panorama = Equirectangular(240, 480)
    camera = EquirectangularCamera((240, 480))
    picture = render_camera(
        make_scene("room", 10_100_007), camera, torch.eye(4), samples_per_pixel=2
    )
    figure = new_figure(8.8, 4.2)
    axes = bare_axes(figure, (0.0, 0.4, 0.62, 0.55), "a panorama")
    axes.imshow(picture.movedim(0, -1))
    lens = FisheyeCamera.from_field_of_view((240, 240), math.radians(200))
    axes = bare_axes(figure, (0.66, 0.4, 0.33, 0.55), "a 200° fisheye")
    axes.imshow(resample(picture, panorama, lens).movedim(0, -1).clamp(0, 1))
    layout = [(math.radians(yaw), 0.0, 0.0) for yaw in YAWS]
    cut = views(picture, None, layout, math.radians(75), (160, 200))
    for k, image in enumerate(cut.images):
        axes = bare_axes(figure, (0.25 * k, 0.0, 0.243, 0.33))
        axes.set_title(f"pinhole, {YAWS[k]}° to the right", fontsize=9)
        axes.imshow(image.movedim(0, -1).clamp(0, 1))
    return to_html(
        figure,
        "A panorama of a room, and a fisheye and four perspective views cut from it",
    )


def resampling_modes() -> str:
    """One photograph around the sphere, read by each mode on a coarser and on a finer grid."""
    wall = torch.from_numpy(brick()).float()[None] / 255
    source = EquirectangularCamera((512, 1024))
    wall = torch.cat((wall, wall), -1)
    coarser, finer = (
        EquirectangularCamera((48, 96)),
        PinholeCamera.from_field_of_view((96, 192), math.radians(5)),
    )
    figure = new_figure(8.8, 2.7)
    for k, mode in enumerate(("nearest", "bilinear", "bicubic", "area")):
        for row, target in enumerate((finer, coarser)):
            axes = bare_axes(
                figure,
                (0.252 * k, 0.46 - 0.46 * row, 0.243, 0.45),
                "" if row else mode,
            )
            axes.imshow(
                remap(wall, source, target, mode=mode)[0],
                cmap="gray",
                vmin=0.15,
                vmax=0.85,
            )
    return to_html(
        figure,
        "One photograph resampled to a finer and to a coarser grid by four modes",
        "A photograph of bricks around the sphere. Above, a view of 5°, seven times finer; below, a "
        "panorama eleven times coarser, "
        "where all modes except the last show a false pattern (aliasing).",
    )


@functools.cache
def scenes() -> str:
    """A fisheye image and the depth of one scene of each kind."""
    camera, panorama = (
        FisheyeCamera.from_field_of_view((96, 96), math.radians(220)),
        Equirectangular(60, 120),
    )
    high = 3.1
    figure = new_figure(8.8, high)
    for k, kind in enumerate(scene_kinds()):
        scene, left, bottom = (
            make_scene(kind, seed=3),
            0.2 * (k % 5),
            2.3 - k // 5 * 0.88,
        )
        image = render_camera(scene, camera, torch.eye(4), samples_per_pixel=2)
        depth = ray_depth(scene, torch.zeros(3), panorama.directions)
        axes = bare_axes(figure, (left, bottom / high, 0.064, 0.58 / high))
        axes.imshow(image.permute(1, 2, 0))
        axes = bare_axes(
            figure, (left + 0.066, bottom / high, 0.128, 0.58 / high), kind
        )
        axes.imshow(depth_to_color(depth, NEAR))
    ticks = depth_ticks(NEAR, spacing=0.1)
    bar_below(
        figure, (0.25, 0.4 / high, 0.5, 0.08 / high), "turbo", "depth (m)", ticks
    )
    return to_html(
        figure,
        "A fisheye image and the depth all around for each kind of rendered scene",
    )
