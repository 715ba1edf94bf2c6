"""Gymnasium: environments and their ids."""
