# SPDX-License-Identifier: Apache-2.0
"""The crown: an icosphere laid out as ten rectangles, and the layers that work on it or on the vertices directly."""

from sphericalvision.crown.block import CrownBlock3d, CrownConvNorm2d, CrownConvNorm3d, crown_block3d
from sphericalvision.crown.conv import CrownConv2d, CrownConv3d, crown_conv2d, crown_conv3d
from sphericalvision.crown.hexconv import HexConv2d, HexConv3d, hex_conv2d, hex_conv3d, north_fraction
from sphericalvision.crown.hexgroup import (
    HexGroupConv2d,
    HexLiftConv2d,
    hex_group_conv2d,
    hex_lift_conv2d,
)
from sphericalvision.crown.layout import Crown, crown_relu, exchange, from_crown, to_crown
from sphericalvision.crown.modules import CrownExchange, CrownPointwise, FromCrown, ToCrown
from sphericalvision.crown.norm import (
    CrownBatchNorm2d,
    CrownBatchNorm3d,
    CrownInstanceNorm2d,
    CrownInstanceNorm3d,
)
from sphericalvision.crown.options import set_kernel_options
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
    "CrownBlock3d",
    "CrownConv2d",
    "CrownConv3d",
    "CrownConvNorm2d",
    "CrownConvNorm3d",
    "CrownExchange",
    "CrownInstanceNorm2d",
    "CrownInstanceNorm3d",
    "CrownMaxPool2d",
    "CrownPointwise",
    "CrownUpsample",
    "FromCrown",
    "HexConv2d",
    "HexConv3d",
    "HexGroupConv2d",
    "HexLiftConv2d",
    "ToCrown",
    "crown_avg_pool2d",
    "crown_block3d",
    "crown_conv2d",
    "crown_conv3d",
    "crown_max_pool2d",
    "crown_relu",
    "crown_upsample",
    "exchange",
    "from_crown",
    "hex_conv2d",
    "hex_conv3d",
    "hex_group_conv2d",
    "hex_lift_conv2d",
    "north_fraction",
    "set_kernel_options",
    "to_crown",
]
