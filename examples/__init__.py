# SPDX-License-Identifier: Apache-2.0
"""Examples of publishers, subscribers and users of the library."""
