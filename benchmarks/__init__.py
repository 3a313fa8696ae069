"""Benchmarks: each file is a program that prints its tables; README.md is the index."""
