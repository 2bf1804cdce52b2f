# SPDX-License-Identifier: Apache-2.0
"""Times are read from every spelling alike, and what is not at the same time is not brought together."""

from collections.abc import Callable
from time import gmtime, strftime

import pytest

from sphericalvision.io.times import are_counts, in_order, nearest_in_time, seconds

MICROSECONDS = [1_418_381_798_086_398 + 62_500 * k for k in range(5)]
SPELLINGS: dict[str, Callable[[int], str]] = {  # of whole microseconds since 1970
    "seconds": lambda time: f"{time // 10**6}.{time % 10**6:06d}",
    "milliseconds": lambda time: f"{time / 1000:.3f}",
    "microseconds": str,
    "nanoseconds": lambda time: str(time * 1000),
    "nanoseconds with decimals": lambda time: f"{time * 1000}.000000",
    "with an exponent": lambda time: f"{time * 1000:.18e}",
    "sec_nsec": lambda time: f"{time // 10**6}_{time % 10**6 * 1000}",
    "sec_nsec, padded": lambda time: f"{time // 10**6}_{time % 10**6 * 1000:09d}",
    "sec_usec": lambda time: f"{time // 10**6}_{time % 10**6:06d}",
    "sec.nsec without zeros in front": lambda time: f"{time // 10**6}.{time % 10**6 * 1000}",
    "a phone's date": lambda time: (
        f"PXL_{strftime('%Y%m%d_%H%M%S', gmtime(time // 10**6))}{time // 1000 % 1000:03d}"
    ),
    "a date": lambda time: (
        f"{strftime('%Y-%m-%d %H:%M:%S', gmtime(time // 10**6))}.{time % 10**6 * 1000:09d}"
    ),
    "a date in a name": lambda time: (
        f"{strftime('%Y-%m-%dT%H-%M-%S', gmtime(time // 10**6))}_{time % 10**6:06d}Z"
    ),
    "after a word": lambda time: f"cloud_{time // 10**6}_{time % 10**6 * 1000:09d}",
}


@pytest.mark.parametrize("spelling", SPELLINGS.values(), ids=SPELLINGS)
@pytest.mark.parametrize("other", SPELLINGS.values(), ids=SPELLINGS)
def test_one_time_in_any_two_spellings_is_one_time(
    spelling: Callable[[int], str], other: Callable[[int], str]
) -> None:
    names = [spelling(time) for time in MICROSECONDS]
    assert not are_counts(names)
    assert seconds(names) == pytest.approx([time * 1e-6 for time in MICROSECONDS], abs=1e-3, rel=0)
    shifted = [other(time + 5_000_000) for time in MICROSECONDS]
    assert nearest_in_time(seconds(names), seconds([other(time) for time in MICROSECONDS])) == [0, 1, 2, 3, 4]
    assert nearest_in_time(seconds(names), seconds(shifted)) == [None] * 5  # five seconds later, in any unit


@pytest.mark.parametrize(
    "names",
    [
        ["1403636579.76", "1403636579.8", "1403636579.81"],  # decimals as Python writes them
        ["1403636579_9", "1403636579_100000000"],
        ["cam1_2", "cam1_10", "cam2_1"],
        ["-0.5", "0", "000012", "100"],
        ["12.8", "12.76", "left"],
    ],
)
def test_names_are_in_the_order_of_times_or_else_of_numbers(names: list[str]) -> None:
    assert in_order(reversed(names)) == names


def test_words_tell_no_time_and_small_numbers_may_be_counts() -> None:
    assert seconds(["left", "a_b", "", "12", "0.5", "-3"]) == [None, None, None, 12.0, 0.5, -3.0]
    no_times = ["frame_12", "1920_1080", "pano_1920_1080", "IMG_20240131_235959", "03_000012"]
    no_times += ["IMG_20240131_235959_001"]  # the first of a second
    assert seconds(no_times) == [None] * len(no_times)
    for dates in (["20240131_235958", "20240131_235959"], ["20240131235959", "20240131235958123"]):
        assert seconds(dates) == [None, None]
    assert seconds(["frame_0.000000", "frame_0.033333"]) == [0, 0.033333]
    assert seconds(["cloud_12_250000000", "12_5"]) == [12.25, pytest.approx(12.000000005, abs=1e-10)]
    assert are_counts(["000001", "12"])
    assert not are_counts(["000001", "12.0"])
    assert nearest_in_time([1.0, None], [], float("inf")) == [None, None]
