"""Use of rclpy: its context, quality of service, messages as bytes, discovery."""
