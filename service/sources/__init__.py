"""Other people's data: what reads them, and what is known of where they come from."""
