"""HTTP: the application, its door, its answers, one file a resource, and the pages."""
