"""The tests, and what holds the tank and the instrument to their figures."""
