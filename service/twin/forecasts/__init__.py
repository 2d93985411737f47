"""Flux forecasts of one heliostat and of a field."""
