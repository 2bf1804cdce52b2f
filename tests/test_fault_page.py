# SPDX-License-Identifier: Apache-2.0
"""The page of faults says what is said."""

from __future__ import annotations

import pytest

from tests.fault_page import PAGE, page


@pytest.mark.slow
def test_the_page_of_faults_is_what_is_said() -> None:
    now, there = page().splitlines(), PAGE.read_text().splitlines()
    assert [line for line in now if line not in there] == [], "python -m tests.fault_page writes it anew"
    assert now == there


def test_it_has_sixty_faults_and_more() -> None:
    assert len([line for line in PAGE.read_text().splitlines() if line.startswith("| ")]) > 60
