"""REST, storage, command line and PAINT import around `model`."""
