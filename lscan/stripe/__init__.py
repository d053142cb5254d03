"""Stripe extractors: where the centre of the laser line is in each column of a picture."""

from lscan.stripe.extract import draw_stripe, extract_stripe, find_extractor, save_stripe

__all__ = ["draw_stripe", "extract_stripe", "find_extractor", "save_stripe"]
