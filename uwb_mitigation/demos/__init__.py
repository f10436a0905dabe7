"""What `make demo`, `make firmware-demo` and `make radio-demo` show: nodes as processes over real DDS."""
