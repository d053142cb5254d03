"""Intervals: how often what is stated holds the truth, counted over draws."""
