# SPDX-License-Identifier: Apache-2.0
"""Batches of samples."""

import torch

from sphericalvision.cameras import ring_rig
from sphericalvision.data.collate import collate_samples


def test_each_sample_keeps_its_own_rig_in_the_batch() -> None:
    rigs = [ring_rig(radius=radius, image_size=(8, 8)) for radius in (0.2, 0.3)]
    samples = [
        {"images": torch.full((4, 3, 42), float(k)), "rig": rig, "frame": str(k)}
        for k, rig in enumerate(rigs)
    ]
    batch = collate_samples(samples)
    assert batch["images"].shape == (2, 4, 3, 42)
    assert batch["frame"] == ["0", "1"]
    assert batch["rig"].world_from_camera.shape == (2, 4, 4, 4)
    for k, rig in enumerate(rigs):
        assert torch.equal(batch["images"][k], samples[k]["images"])
        torch.testing.assert_close(batch["rig"].world_from_camera[k], rig.world_from_camera)


def test_tensors_in_dicts_are_stacked() -> None:
    batch = collate_samples(
        [{"images": {"cam1": torch.zeros(3, 2, 2)}}, {"images": {"cam1": torch.ones(3, 2, 2)}}]
    )
    assert batch["images"]["cam1"].mean(dim=(1, 2, 3)).tolist() == [0, 1]
