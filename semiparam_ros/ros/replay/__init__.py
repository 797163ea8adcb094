"""The tool `bag_replay`: a playback published on ROS topics."""
