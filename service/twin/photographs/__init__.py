"""Photographs: ingest, repeats, corrections, deletion, display."""
