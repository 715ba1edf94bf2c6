"""The closed form as an engine: many robots at a time, without a solver."""
