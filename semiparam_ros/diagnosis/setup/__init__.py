"""Checks that a recording is what it says: units, signs, orders, axes, clocks and mounting."""
