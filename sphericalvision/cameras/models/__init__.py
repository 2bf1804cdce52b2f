# SPDX-License-Identifier: Apache-2.0
"""Camera models, one file each: a pair of pure functions and a class on top of them."""
