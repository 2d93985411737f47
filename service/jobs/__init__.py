"""Work that outlives a request: one file a kind, and the worker."""
