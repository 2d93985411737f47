"""REST: one file a resource, with its schema, its representations and its routes."""
