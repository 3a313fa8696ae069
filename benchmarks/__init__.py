# SPDX-License-Identifier: Apache-2.0
"""Benchmarks: each file is a program that prints its tables; README.md is the index."""
