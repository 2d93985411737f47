"""Foundations of the service: settings, logs, names, errors, field types."""
