"""Authentication, authorization, and limits on requests."""
