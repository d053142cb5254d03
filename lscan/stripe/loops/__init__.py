"""Loops over lines that are compiled: arrays in and arrays out, without records.

Those of a fit are beside its records in ``lscan.stripe.fit``.  None calls one of another file:
numba keeps what it compiled for as long as its own file stays.
"""
