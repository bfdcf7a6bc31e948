"""Enumerations, permissions, identifiers and errors. Imports only the standard library."""
