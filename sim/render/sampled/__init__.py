"""Integrators that sample light: the first order, and all orders where nothing else serves."""
