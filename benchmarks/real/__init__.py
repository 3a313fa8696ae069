# SPDX-License-Identifier: Apache-2.0
"""Real detections and recorded bags."""
