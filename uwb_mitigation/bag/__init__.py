"""MCAP bags in the ROS 2 profile, without ROS: message schemas, the CDR codec, a reader that distrusts
every byte, and a writer that never leaves half a bag. What the topics mean is in `topics`.
"""
