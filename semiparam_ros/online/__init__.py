"""Learning while samples come, without ROS: the active model, its changes, its gate and its memory."""
