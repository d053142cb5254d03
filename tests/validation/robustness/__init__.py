"""Drivers, runs and the live page under faults."""
