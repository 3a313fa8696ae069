"""The paper's tables and what its method depends on."""
