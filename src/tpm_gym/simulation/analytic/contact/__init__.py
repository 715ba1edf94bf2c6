"""Contacts of objects with each other, with the table and with the cup, for many robots."""

from tpm_gym.simulation.analytic.contact.contact import Contact, Reading

__all__ = ["Contact", "Reading"]
