"""Singularities, aspects, topology, decoupling, and a Delta; environments do not need this."""
