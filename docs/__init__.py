# SPDX-License-Identifier: Apache-2.0
"""Documentation: pages written by hand, and the reference that `generate` writes."""
