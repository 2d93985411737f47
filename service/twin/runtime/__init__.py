"""Common parts of all computations: the model, compute slots, background caches and engines."""
