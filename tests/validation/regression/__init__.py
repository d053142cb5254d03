"""What those who test algorithms without a tank rely on, measured."""
