"""Training of policies: single runs, the preference loop, and the steps that they share with the service."""
