"""What holds the tank and the instrument to their bars."""
