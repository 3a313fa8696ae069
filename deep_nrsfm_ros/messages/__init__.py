# SPDX-License-Identifier: Apache-2.0
"""Messages of detectors: bytes and fields to observations; no ROS import."""
