# SPDX-License-Identifier: Apache-2.0
"""A few characters that stand for a rig: for tables and files that depend on it."""

from __future__ import annotations

from hashlib import sha256

from jaxtyping import Shaped
from torch import Tensor

from sphericalvision.cameras.rig import CameraRig


def rig_fingerprint(rig: CameraRig, extra: object = "", digits: int = 5) -> str:
    """Sixteen characters for the poses, cameras and masks of a rig; names of cameras play no part.

    Args:
        rig: single, or a batch.
        extra: whatever else shall tell fingerprints apart, by its ``repr``.
        digits: significant digits of numbers; rigs that differ in later ones only have the same fingerprint.

    Examples:
        >>> import torch
        >>> from sphericalvision.cameras import ring_rig
        >>> rig_fingerprint(ring_rig(4)) == rig_fingerprint(ring_rig(4).to(torch.float64))
        True
        >>> rig_fingerprint(ring_rig(4)) == rig_fingerprint(ring_rig(4).rotated(tilt=0.1))
        False
    """
    digest = sha256(repr(extra).encode())
    digest.update(rounded_text(rig.world_from_camera, digits))
    for name, camera in rig.cameras.items():
        options = [getattr(camera, option) for option in camera.option_names]
        digest.update(repr((camera.model, camera.image_size, options)).encode())
        for parameter in (*camera.intrinsic_names, "max_angle"):
            value = getattr(camera, parameter)
            digest.update(b"" if value is None else rounded_text(value, digits))
        if name in rig.masks:
            digest.update(rig.masks[name].cpu().numpy().tobytes())
    return digest.hexdigest()[:16]


def rounded_text(values: Shaped[Tensor, " ..."], digits: int = 5) -> bytes:
    """Numbers as text of a few digits: float32 and float64, and other ways to compute them, give the same."""
    numbers = values.detach().cpu().double().flatten().tolist()
    return " ".join(f"{0.0 if abs(value) < 1e-6 else value:.{digits}g}" for value in numbers).encode()
