"""One heliostat: its mount, its accepted measurements and their metadata."""
