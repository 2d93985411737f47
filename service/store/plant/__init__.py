"""Storage of the plant: geometry, versions of its model, removal."""
