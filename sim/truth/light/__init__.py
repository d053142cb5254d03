"""How bright the true line is in its picture."""
