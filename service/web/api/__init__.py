"""REST API: one module for each resource, with its schema, representations and routes."""
