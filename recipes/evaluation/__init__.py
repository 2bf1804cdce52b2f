# SPDX-License-Identifier: Apache-2.0
"""One harness for all comparisons: methods on sets of frames, errors of each frame kept in records, tables of them.

``evaluate`` (loop) lets every ``Method`` (methods) estimate the frames of a ``FrameSet`` (frames), takes the errors
that a ``Measure`` defines, and adds them to a ``Record`` (records) for each method. A ``Table`` (tables)
shows means of records. The commands ``evaluate`` and ``study`` differ in their frames, measures and tables alone.
"""
