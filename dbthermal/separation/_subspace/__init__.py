"""The subspace separator: kernels of its five steps."""
