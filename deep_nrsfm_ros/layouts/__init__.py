# SPDX-License-Identifier: Apache-2.0
"""Keypoint layouts: the keypoints of an object, their order and how they are connected.

`layout` has the type, `presets` the layouts that come with the package, `layout_file` the reader of
both the presets' and the users' files, and `keypoint_map` takes keypoints from one layout to
another by name.
"""
