"""The field report: measurements and checks on a board."""
