# SPDX-License-Identifier: Apache-2.0
"""IcoSweepNet in the obvious way: what the benchmark measures the package against.

The same weights and the same outputs, by index tables, one convolution a direction, normalisation as a layer of its
own, and one look-up a camera and hypothesis.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from sphericalvision.crown import to_crown
from sphericalvision.crown.conv import COL_TAPS, ROW_TAPS
from sphericalvision.icosphere import num_icosphere_vertices
from sphericalvision.models import IcoSweepNet
from sphericalvision.models.features import ConvNorm2d, ResidualBlock
from sphericalvision.models.regularization import ConvNorm3d, CostBlock
from sphericalvision.sweep import SweepTables, soft_argmax

__all__ = ["PlainNetwork"]

Pair = tuple[Tensor, Tensor]


class PlainNetwork(nn.Module):
    """The concatenating ``IcoSweepNet`` with batch normalisation, evaluated plainly with the same parameters.

    Examples:
        >>> from sphericalvision.cameras import ring_rig
        >>> net = IcoSweepNet(3, num_hypotheses=4, feature_channels=2, num_cameras=2).eval()
        >>> images, tables = torch.rand(1, 2, 3, 642), net.sweep.tables(ring_rig(2))
        >>> torch.allclose(PlainNetwork(net)(images, tables), net(images, tables), atol=1e-4)
        True
    """

    def __init__(self, net: IcoSweepNet) -> None:
        super().__init__()
        self.net = net
        self.places = {level: _places(level) for level in range(net.level - 2, net.level + 1)}

    def forward(self, images: Tensor, tables: SweepTables) -> Tensor:
        """Return the hypothesis index ``(B, V)``; in training mode with statistics of the batch."""
        features = torch.stack([self.features(camera) for camera in images.unbind(1)], 1)
        return soft_argmax(self.regularize(self.volume(features, tables)))

    def features(self, images: Tensor) -> Tensor:
        """Features of one camera."""
        net, level = self.net.features, self.net.level
        pair = self._relu(self._conv_norm(net.entry, self._unfold(images, level)))
        pair = self._relu(self._conv_norm(net.second, pair))
        pair = self._exchange(pair, level - 1)
        for block in net.fine:
            pair = self._residual(block, pair)
        pair = self._exchange(pair, level - 1)
        for block in net.coarse:
            pair = self._residual(block, pair)
        pair = self._exchange(pair, level - 2)
        return self._fold(self._convolve(pair, net.last.weight), level - 2)

    def volume(self, features: Tensor, tables: SweepTables) -> Tensor:
        """The concatenated cost volume: a look-up for each camera and each hypothesis."""
        cameras = []
        for camera in range(features.shape[1]):
            depths = []
            for depth in range(tables.ids.shape[-4]):
                ids, weights = tables.ids[depth, :, camera], tables.weights[depth, :, camera]
                corners = [features[:, camera][:, :, ids[:, k]] * weights[:, k] for k in range(3)]
                depths.append(corners[0] + corners[1] + corners[2])
            cameras.append(torch.stack(depths, 2))
        return torch.cat(cameras, 1)

    def regularize(self, volume: Tensor) -> Tensor:
        """Scores of the hypotheses."""
        net, level = self.net.regularizer, self.net.level - 2
        pair = self._exchange(self._block(net.fusion, self._unfold(volume, level)), level)
        for block in net.blocks:
            assert isinstance(block, CostBlock)
            change = self._block(block, pair)
            pair = self._exchange((pair[0] + change[0], pair[1] + change[1]), level)
        pair = self._relu(self._conv_norm(net.reduction, pair))
        return self._fold(self._convolve(pair, net.score.weight), level).squeeze(1)

    def _block(self, block: CostBlock, pair: Pair) -> Pair:
        return self._conv_norm(block.second, self._relu(self._conv_norm(block.first, pair)))

    def _residual(self, block: nn.Module, pair: Pair) -> Pair:
        assert isinstance(block, ResidualBlock)
        change = self._conv_norm(block.second, self._relu(self._conv_norm(block.first, pair)))
        stride = block.first.conv.stride
        if stride > 1:
            pair = self._map(lambda x: F.avg_pool2d(x, 3, stride, 1, count_include_pad=False), pair)
        return self._relu((pair[0] + change[0], pair[1] + change[1]))

    def _conv_norm(self, layer: ConvNorm2d | ConvNorm3d, pair: Pair) -> Pair:
        norm = layer.norm
        col, row = self._convolve(pair, layer.conv.weight, layer.conv.stride)
        both = torch.cat((col.flatten(-2), row.flatten(-2)))
        both = F.batch_norm(
            both,
            norm.running_mean if not self.training else None,
            norm.running_var if not self.training else None,
            norm.weight,
            norm.bias,
            self.training,
            eps=norm.eps,
        )
        first, second = both.chunk(2)
        return first.reshape(col.shape), second.reshape(row.shape)

    def _convolve(self, pair: Pair, weight: Tensor, stride: int = 1) -> Pair:
        def kernel(taps: tuple[tuple[int, ...], ...]) -> Tensor:
            planes = weight.unflatten(-1, (-1, 7))
            return F.pad(planes, (0, 1))[..., torch.tensor(taps).flatten()].unflatten(-1, (3, 3))

        results = []
        for x, taps in zip(pair, (COL_TAPS, ROW_TAPS), strict=True):
            if x.ndim == 5:
                padded = F.pad(x, (1, 1, 1, 1, 1, 1), mode="replicate")
                results.append(F.conv3d(padded, kernel(taps), stride=(1, stride, stride)))
            else:
                padded = F.pad(x, (1, 1, 1, 1), mode="replicate")
                results.append(F.conv2d(padded, kernel(taps).squeeze(2), stride=stride))
        return results[0], results[1]

    def _relu(self, pair: Pair) -> Pair:
        return torch.relu(pair[0]), torch.relu(pair[1])

    def _map(self, function: object, pair: Pair) -> Pair:
        assert callable(function)
        return function(pair[0]), function(pair[1])

    def _unfold(self, values: Tensor, level: int) -> Pair:
        """Rectangles ``(5 B, C, [N,] h, w)``, one after the other in the batch."""
        col, row = (values[..., places].movedim(-3, 1).flatten(0, 1) for places in self.places[level])
        return col.contiguous(), row.contiguous()

    def _fold(self, pair: Pair, level: int) -> Tensor:
        places = torch.cat([p.flatten() for p in self.places[level]])
        values = torch.cat([x.unflatten(0, (-1, 5)).movedim(1, -3).flatten(-3) for x in pair], -1)
        vertices = num_icosphere_vertices(level)
        total = values.new_zeros(*values.shape[:-1], vertices).index_add(-1, places, values)
        return total / values.new_zeros(vertices).index_add(0, places, values.new_ones(len(places)))

    def _exchange(self, pair: Pair, level: int) -> Pair:
        return self._unfold(self._fold(pair, level), level)


def _places(level: int) -> Pair:
    """Vertex of every place of the crown, ``(5, h, w)`` each."""
    crown = to_crown(torch.arange(num_icosphere_vertices(level), dtype=torch.float64)[None, None])
    return crown.col[0, :, 0].long(), crown.row[0, :, 0].long()
