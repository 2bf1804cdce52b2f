# SPDX-License-Identifier: Apache-2.0
"""How far off views of py360convert 1.0.4 and pyequilib 0.6.0 are: the table of "Choosing a representation".

Run after ``pip install py360convert==1.0.4 pyequilib==0.6.0``. Every pixel of a panorama holds the direction in
which it looks, so that a view tells where it was read.
"""

from __future__ import annotations

import equilib
import py360convert
import torch
from torch import Tensor

from sphericalvision.cameras import PinholeCamera
from sphericalvision.sphere import Equirectangular, resample


def main() -> None:
    """Print the maximum error of each view, in pixels of the panorama, in the central half of the view."""
    panorama = Equirectangular(256, 512, dtype=torch.float64)
    directions = panorama.directions.movedim(-1, 0)
    camera = PinholeCamera([32.0, 32.0], [31.5, 31.5], (64, 64)).to(torch.float64)
    rays = camera.unproject(camera.pixel_grid()).directions

    def error(view: Tensor) -> float:
        pixels = panorama.pixels(view.double().movedim(0, -1))
        return (pixels - panorama.pixels(rays))[16:48, 16:48].abs().max().item()

    print("here", error(resample(directions, panorama, camera)))
    image = directions.movedim(0, -1).float().numpy()
    view = py360convert.e2p(image, (90, 90), 0, 0, (64, 64))
    print("py360convert", error(torch.from_numpy(view).movedim(-1, 0)))
    ahead = [{"roll": 0.0, "pitch": 0.0, "yaw": 0.0}]
    batch = directions[None].float()
    options = {"height": 64, "width": 64, "fov_x": 90.0, "clip_output": False}
    print("pyequilib, view", error(equilib.equi2pers(batch, ahead, **options)[0]))
    faces = equilib.equi2cube(
        batch, ahead, w_face=64, cube_format="list", clip_output=False
    )
    print("pyequilib, face", error(faces[0][0]))


if __name__ == "__main__":
    main()
