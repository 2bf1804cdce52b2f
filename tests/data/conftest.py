# SPDX-License-Identifier: Apache-2.0
"""A small rig like that of the published sets, and frames of noise for it."""

from collections.abc import Callable

import pytest

from sphericalvision.cameras import CameraRig, ring_rig
from sphericalvision.data.collate import Sample
from tests.worlds import frames_of_noise


@pytest.fixture
def rig() -> CameraRig:
    return ring_rig(image_size=(50, 48))


@pytest.fixture
def frames(rig: CameraRig) -> Callable[..., list[Sample]]:
    """Function of frame numbers, and the panorama's height and width; frames for ``rig``."""
    return lambda *numbers, **size: frames_of_noise(rig, numbers, **size)
