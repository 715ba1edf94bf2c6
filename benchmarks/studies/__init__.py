"""Trainings and tests behind docs/results.md, and the code that writes this page."""
