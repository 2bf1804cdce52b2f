# SPDX-License-Identifier: Apache-2.0
"""What needs a C++ compiler."""

import shutil

import pytest

__all__ = ["needs_compiler"]

needs_compiler = pytest.mark.skipif(shutil.which("c++") is None, reason="needs a C++ compiler")
