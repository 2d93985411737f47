"""The routes, one file a resource; they translate and nothing else."""
