"""Football: four academy scenarios of Google Research Football, on its engine, which is installed separately."""
