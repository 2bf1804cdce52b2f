# SPDX-License-Identifier: Apache-2.0
"""One harness for all comparisons: methods on sets of frames, errors of each frame kept in records, tables of them.

``evaluate`` (loop) lets every ``Method`` (methods) estimate the frames of a ``FrameSet`` (loop, track_frames), takes
the errors that a ``Measure`` defines (loop, places, protocols, strips), and adds them to a ``Record`` (records) for
each method. A ``Table`` (tables) shows means of records. ``sphericalvision-evaluate``, the study and the benchmark
differ in their frames, measures and tables alone.
"""
