"""Runs of a policy without the service: trained, resumed, evaluated, compared."""
