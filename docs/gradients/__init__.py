"""Studies of docs/gradients.md: lengths and motions, improved by closed-form gradients."""
