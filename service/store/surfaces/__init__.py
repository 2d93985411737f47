"""Storage of surface versions, and decisions which one is active."""
