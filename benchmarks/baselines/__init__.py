# SPDX-License-Identifier: Apache-2.0
"""Other methods of non-rigid structure from motion, on the same frames."""
