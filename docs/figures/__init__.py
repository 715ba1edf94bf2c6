"""Figures of docs/figures.md: data (zero_sets, skeleton) and drawings, one module for each kind."""
