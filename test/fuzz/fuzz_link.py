"""Runs a target of `link_targets.py`, guided by coverage (needs `pip install atheris`; Linux).

For ten minutes each, from the root of the repository:

    PYTHONPATH=. python test/fuzz/fuzz_link.py decoder -max_total_time=600 -max_len=20000
    PYTHONPATH=. python test/fuzz/fuzz_link.py session -max_total_time=600 -max_len=4096
    PYTHONPATH=. python test/fuzz/fuzz_link.py board -max_total_time=600 -max_len=4096
"""

import sys

import atheris

with atheris.instrument_imports(include=["uwb_mitigation"]):
    import link_targets

if __name__ == "__main__":
    target = link_targets.TARGETS[sys.argv.pop(1)]
    atheris.Setup(sys.argv, target)
    atheris.Fuzz()
