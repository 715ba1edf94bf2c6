"""The closed form as an engine, for batches of machines."""
