"""ROS 2 messages without ROS: topic names, schemas and the CDR codec."""
