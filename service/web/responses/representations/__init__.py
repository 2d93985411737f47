"""Representations of maps other than JSON, one module each with its `REPRESENTATION`."""
