"""Singularities, aspects and topology; no environment imports this."""
