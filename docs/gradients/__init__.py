"""The studies of docs/gradients.md: lengths and ways, improved by the closed form's gradients."""
