"""What holds the tank and the instrument to their figures: ``make validate``."""
