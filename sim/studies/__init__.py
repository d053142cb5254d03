"""Studies of where an error comes from."""
