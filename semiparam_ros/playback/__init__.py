"""Playing a recording, without ROS: order, pace, flow control, and what a user sees and steers."""
