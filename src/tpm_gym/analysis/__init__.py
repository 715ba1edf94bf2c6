"""Singularities, aspects, topology, decoupling, and other mechanisms; no environment imports this."""
