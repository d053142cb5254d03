"""Stripe extractors: where the centre of the laser line is in each column of a picture."""
