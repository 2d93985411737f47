"""What stands at the root beside the pages: probes, metrics, the session, the documentation, styles and scripts."""
