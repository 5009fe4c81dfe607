"""The default method, "subspace": its five steps, as arrays and compiled."""
