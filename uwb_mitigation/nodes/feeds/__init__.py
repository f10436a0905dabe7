"""Sources of the driver: radios, UCI boards, topics, and replayed recordings."""
