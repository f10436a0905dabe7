"""A page in the browser on live topics or on a recording: it reads, and never writes."""
