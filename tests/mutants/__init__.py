"""Mutants: mistakes put into lscan and sim, one at a time, each of which a quick test must notice."""
