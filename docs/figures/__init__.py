"""The figures of docs/figures.md: data (zero_sets, mechanism) and drawings, one module a kind."""
