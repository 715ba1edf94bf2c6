"""The analytic engine."""
