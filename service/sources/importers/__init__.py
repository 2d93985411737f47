"""Whose folders are read, one file a source, with its `IMPORTER`."""
