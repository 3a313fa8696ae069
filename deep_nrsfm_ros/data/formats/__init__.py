# SPDX-License-Identifier: Apache-2.0
"""Formats of keypoint files, one in each file, behind the table in `data.keypoint_files`."""
