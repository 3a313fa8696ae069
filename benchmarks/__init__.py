"""The paper's experiments: one command a table, from a folder of data."""
