# SPDX-License-Identifier: Apache-2.0
"""Images of one camera as another would have taken them."""
