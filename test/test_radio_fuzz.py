"""Frame parser, driver and exchange with sanitizers: arbitrary bytes, orders and registers."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest
from compilers import NEEDS_CC

from uwb_mitigation.mitigation.embedded.compiling import (
    c_compiler,
    compile_objects,
    firmware_folder,
    run_tool,
)

SANITIZED = ("-std=c99", "-g", "-O1", "-fno-sanitize-recover=all")

pytestmark = NEEDS_CC


def build(folder: Path, compiler: tuple[str, ...], *flags: str) -> Path:
    """Return the fuzz target."""
    firmware = firmware_folder()
    sources = (*(firmware / "src").glob("uwb_dw1000*.c"), *(firmware / "src").glob("uwb_twr*.c"))
    options = (*SANITIZED, *flags, f"-I{firmware / 'src'}")
    objects = compile_objects(compiler, options, tuple(sorted(sources)))
    program = folder / "fuzz_radio"
    main = firmware / "test" / "fuzz_radio.c"
    run_tool([*compiler, *options, str(main), *objects, "-lm", "-o", str(program)])
    return program


def test_arbitrary_frames_and_registers_yield_no_false_range(tmp_path: Path):
    output = run_tool([str(build(tmp_path, c_compiler(), "-fsanitize=address,undefined")), "300", "1"])
    ranged, refused = (int(output.split()[i]) for i in (0, 2))
    assert ranged > 1000
    assert refused > 5000


@pytest.mark.skipif(shutil.which("clang") is None, reason="no clang: apt install clang")
def test_brief_fuzzing_finds_no_failure(tmp_path: Path):
    program = build(tmp_path, ("clang",), "-fsanitize=fuzzer,address,undefined", "-DUWB_LIBFUZZER")
    options = ("-runs=1000", "-seed=1", "-max_len=8000", "-len_control=0")
    result = subprocess.run([program, *options], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr[-2000:]
