"""What `make demo` and `make firmware-demo` show: nodes as processes over real DDS."""
