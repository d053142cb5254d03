"""How near the instrument comes to the tank's truth: every figure of the accuracy table."""
