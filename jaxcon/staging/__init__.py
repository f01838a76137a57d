"""Batches of worlds along the last axis, masked gradients, staged kernels. No mechanics."""
