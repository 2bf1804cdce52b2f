# SPDX-License-Identifier: Apache-2.0
"""Data for Lightning's trainer."""

from typing import Any

import pytorch_lightning as pl
import torch

from sphericalvision.recipes.datamodules.data_module import ENDLESS, Loader, Sample, SampleDataModule


class Loaders(pl.LightningDataModule):
    """The loaders of a data module for a trainer's process, from where a resumed run stopped.

    Args:
        data: makes the loaders.
    """

    def __init__(self, data: SampleDataModule) -> None:
        super().__init__()
        self.data = data
        self.batches_seen = 0

    def prepare_data(self) -> None:
        """Write what training and validation will read, in one process."""
        self.data.prepare_data()

    def setup(self, stage: str) -> None:
        """Read what each process needs."""
        self.data.setup(stage)

    def train_dataloader(self) -> Loader:
        """Training batches up to ``trainer.max_steps``."""
        trainer = self._bound()
        steps = trainer.max_steps * trainer.accumulate_grad_batches
        return self.data.train_dataloader(
            steps if steps > 0 else ENDLESS, self.batches_seen, *self._process()
        )

    def val_dataloader(self) -> Loader:
        """Validation batches of this process."""
        return self.data.val_dataloader(*self._process())

    def test_dataloader(self) -> Loader:
        """Test batches of this process."""
        return self.data.test_dataloader(*self._process())

    def _process(self) -> tuple[int, int]:
        """Number of this process and of all."""
        trainer = self._bound()
        return trainer.global_rank, trainer.world_size

    def _bound(self) -> pl.Trainer:
        assert self.trainer is not None
        return self.trainer

    def transfer_batch_to_device(self, batch: Sample, device: torch.device, dataloader_idx: int) -> Sample:
        """Move all of a batch but its rigs: their tables are made on the device, and known by numbers on the host."""
        rest: Any = {name: values for name, values in batch.items() if name != "rig"}
        return {**batch, **super().transfer_batch_to_device(rest, device, dataloader_idx)}

    def state_dict(self) -> dict[str, int]:
        """Number of training batches that were used up, for a resumed run."""
        trainer = self._bound()
        return {"batches_seen": trainer.global_step * trainer.accumulate_grad_batches * trainer.world_size}

    def load_state_dict(self, state_dict: dict[str, int]) -> None:
        """Continue behind the batches that were used up."""
        self.batches_seen = state_dict["batches_seen"]
