# SPDX-License-Identifier: Apache-2.0
"""The crown: an icosphere laid out as ten rectangles, and the layers that work on it or on the vertices directly."""

from sphericalvision.crown.conv import (
    CrownConv2d,
    CrownConv3d,
    crown_conv2d,
    crown_conv3d,
)
from sphericalvision.crown.fast.chain import crown_conv3d_chain
from sphericalvision.crown.fast.native import native_operators
from sphericalvision.crown.hexconv import HexConv2d, HexConv3d, hex_conv2d, hex_conv3d, north_fraction
from sphericalvision.crown.hexpad import hex_pad
from sphericalvision.crown.layout import Crown, crown_map, crown_relu, exchange, from_crown, to_crown
from sphericalvision.crown.modules import CrownExchange, CrownPointwise, FromCrown, ToCrown
from sphericalvision.crown.norm import (
    CrownBatchNorm2d,
    CrownBatchNorm3d,
    CrownInstanceNorm2d,
    CrownInstanceNorm3d,
    crown_norm,
)
from sphericalvision.crown.pool import (
    CrownAvgPool2d,
    CrownMaxPool2d,
    CrownUpsample,
    crown_avg_pool2d,
    crown_max_pool2d,
    crown_upsample,
)

__all__ = [
    "Crown",
    "CrownAvgPool2d",
    "CrownBatchNorm2d",
    "CrownBatchNorm3d",
    "CrownConv2d",
    "CrownConv3d",
    "CrownExchange",
    "CrownInstanceNorm2d",
    "CrownInstanceNorm3d",
    "CrownMaxPool2d",
    "CrownPointwise",
    "CrownUpsample",
    "FromCrown",
    "HexConv2d",
    "HexConv3d",
    "ToCrown",
    "crown_avg_pool2d",
    "crown_conv2d",
    "crown_conv3d",
    "crown_conv3d_chain",
    "crown_map",
    "crown_max_pool2d",
    "crown_norm",
    "crown_relu",
    "crown_upsample",
    "exchange",
    "from_crown",
    "hex_conv2d",
    "hex_conv3d",
    "hex_pad",
    "native_operators",
    "north_fraction",
    "to_crown",
]
