"""Velocities and accelerations of joints: estimated as samples come, or from a whole recording."""
