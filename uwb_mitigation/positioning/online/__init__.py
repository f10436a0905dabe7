"""The filter of one tag, updated with each range; with odometry also the heading."""
