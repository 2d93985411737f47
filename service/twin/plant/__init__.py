"""The plant's geometry and the versions of its model."""
