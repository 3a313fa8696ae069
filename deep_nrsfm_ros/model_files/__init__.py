# SPDX-License-Identifier: Apache-2.0
"""Model files: their format, the folders where they are found, and names for them."""
