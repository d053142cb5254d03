"""The command line of the tank."""
