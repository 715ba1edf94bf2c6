"""Singularities, aspects, topology and decoupling; environments do not need this."""
