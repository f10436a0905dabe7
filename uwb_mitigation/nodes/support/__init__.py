"""What all nodes share: lifecycle, parameters, topics, diagnostics, and starting processes."""
