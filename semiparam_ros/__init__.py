"""Online semi-parametric learning of a robot's inverse dynamics, as a ROS 2 package."""

__version__ = '0.1.0'
