"""The tool `semiparam record`: ROS topics written into a bag."""
