"""Import and export of measurement folders with their history."""
