"""Other people's data: what reads measurement folders and documents that the plant sends."""
