"""What the parts of the system can do, measured from outside; `uwb-mitigation bench` shows it."""
