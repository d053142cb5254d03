"""Figures of the error budgets."""
