"""Measured comparisons: ``make bench`` prints the figures of RESULTS.md."""
