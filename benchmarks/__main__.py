"""`python -m benchmarks`: runs `cli`, and handles signals while it loads."""

from uwb_mitigation.commands.entry import run_program

if __name__ == "__main__":
    run_program("benchmarks.cli", "main")
