# SPDX-License-Identifier: Apache-2.0
"""Command-line programs, each thin: options in, the library called, progress shown."""
