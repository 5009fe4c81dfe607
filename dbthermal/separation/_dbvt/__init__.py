"""The paper's optimiser."""
