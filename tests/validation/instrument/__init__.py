"""The instrument against the ground truth of the tank."""
