"""Background jobs: one file per kind, and the worker."""
