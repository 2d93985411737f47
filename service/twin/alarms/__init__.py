"""Field overview, heliostat filters, and alarms for the operator."""
