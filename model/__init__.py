"""The heliostat and its light: pure functions and small frozen dataclasses, without database, HTTP or files."""
