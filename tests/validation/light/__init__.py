"""The tank's light: every effect against a closed form, a known value or another renderer."""
