"""Training of policies: single runs, the preference loop, and the steps they share with the service."""
