"""Words, rules and errors of Accord. Imports the standard library alone."""
