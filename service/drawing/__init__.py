"""Pictures, charts and the report of a study, which can be mailed."""
