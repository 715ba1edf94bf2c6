"""Contacts of objects with other objects, table and cup, for many robots."""

from tpm_gym.simulation.analytic.contact.contact import Contact, Reading
from tpm_gym.simulation.analytic.contact.state import Route

__all__ = ["Contact", "Reading", "Route"]
