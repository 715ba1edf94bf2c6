"""From runs to docs/results.md: what is kept of each run, the page and its figures."""
