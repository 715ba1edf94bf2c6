"""Singularities, aspects, topology, decoupling, a Delta beside ours; no environment imports it."""
