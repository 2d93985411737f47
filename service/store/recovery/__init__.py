"""Back-ups, and integrity checks of the store."""
