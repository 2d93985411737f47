"""Storage of measurements and their image files."""
