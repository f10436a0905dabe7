"""The ROS 2 side: thin shells around the sources and the model. The only place that imports rclpy."""
