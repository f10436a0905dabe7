"""`python -m benchmarks`: runs `cli`, and handles signals while it loads."""

from uwb_mitigation.entry import run_program

run_program("benchmarks.cli")
