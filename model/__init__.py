"""The heliostat and its light: pure functions and frozen dataclasses, without database or HTTP."""
