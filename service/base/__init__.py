"""What every room stands on: settings, logs, names, faults, types of fields."""
