"""Storage of calibrated mounts."""
