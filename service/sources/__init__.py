"""Readers of external data: measurement folders and documents that the plant sends."""
