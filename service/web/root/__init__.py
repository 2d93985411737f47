"""Routes at the root next to the pages: probes, metrics, session, documentation and assets."""
