"""Residual that no effect explains: whether it is noise, what it depends on, and a formula for it."""
