"""Field overview, heliostat filters, and alerts for the operator."""
