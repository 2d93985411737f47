"""The representations of maps beside JSON, one file each, with its `REPRESENTATION`."""
