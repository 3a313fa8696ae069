# SPDX-License-Identifier: Apache-2.0
"""Latency, training speed and memory, side by side with floors and other ways."""
