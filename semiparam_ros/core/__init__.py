"""The estimator and its mathematics: numbers in, predictions out, with no files and no ROS."""
