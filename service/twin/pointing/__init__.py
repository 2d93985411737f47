"""Calibrated mounts and pointing errors."""
