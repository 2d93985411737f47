"""Pictures, charts and the HTML report of a study."""
