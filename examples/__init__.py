# SPDX-License-Identifier: Apache-2.0
"""Examples: what to put before the lifter."""
