"""Importers of folders, one file for each source, with its `IMPORTER`."""
