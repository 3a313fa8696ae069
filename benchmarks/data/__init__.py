# SPDX-License-Identifier: Apache-2.0
"""Data of the benchmarks: synthetic objects, MATLAB files and the pose2sim session."""
