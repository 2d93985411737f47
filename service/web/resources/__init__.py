"""Resources: each answers REST and browsers from the same functions and models."""
