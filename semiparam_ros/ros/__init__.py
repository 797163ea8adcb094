"""What this package shares with rclpy: its context, quality of service, messages as bytes, discovery."""
