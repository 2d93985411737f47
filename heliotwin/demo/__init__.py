"""Plants of the demonstration: mirrors with known surfaces and faults, and their photographs."""
