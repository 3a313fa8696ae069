# SPDX-License-Identifier: Apache-2.0
"""Training: the loop and everything around it, from the request to the record on disk; no ROS."""
