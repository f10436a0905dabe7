"""MCAP bags in the ROS 2 profile, without ROS.

Contains message schemas, the CDR codec, a reader that validates all input, and an atomic writer. `topics` documents
the topics.
"""
