"""The robot: its description, the regressor of its rigid bodies, forces at its links, feedforward."""
