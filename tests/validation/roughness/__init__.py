"""Roughness held against fields, blocks and sounds that are known."""
