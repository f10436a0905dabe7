"""Frame parser, driver and exchange with sanitizers: arbitrary bytes, orders and registers."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest
from compilers import NEEDS_CC

from uwb_mitigation.errors import UwbMitigationError
from uwb_mitigation.mitigation.embedded.compiling import (
    c_compiler,
    compile_objects,
    firmware_folder,
    run_tool,
)

SANITIZED = ("-std=c99", "-g", "-O1", "-fno-sanitize-recover=all")

pytestmark = NEEDS_CC


def build(
    folder: Path, compiler: tuple[str, ...], *flags: str, broken: tuple[str, str] | None = None
) -> Path:
    """Return the fuzz target; `broken` replaces a check in the exchange."""
    firmware = firmware_folder()
    exchange = firmware / "src" / "uwb_twr_common.c"
    others = {*(firmware / "src").glob("uwb_dw1000*.c"), *(firmware / "src").glob("uwb_twr*.c")} - {exchange}
    if broken is not None:
        text = exchange.read_text()
        assert broken[0] in text
        exchange = folder / "uwb_twr_common.c"
        exchange.write_text(text.replace(*broken))
    options = (*SANITIZED, *flags, f"-I{firmware / 'src'}")
    objects = compile_objects(compiler, options, tuple(sorted(others)))
    main = firmware / "test" / "fuzz_radio.c"
    program = folder / "fuzz_radio"
    run_tool([*compiler, *options, str(main), str(exchange), *objects, "-lm", "-o", str(program)])
    return program


def test_arbitrary_frames_and_registers_yield_no_false_range(tmp_path: Path):
    output = run_tool([str(build(tmp_path, c_compiler(), "-fsanitize=address,undefined")), "300", "1"])
    ranged, refused = (int(output.split()[i]) for i in (0, 2))
    assert ranged > 1000
    assert refused > 5000


@pytest.mark.parametrize(
    "check",
    [
        ("frame->tag_number == sent->tag_number", "1"),
        ("frame->pan == twr->config.pan", "1"),
        ("frame->anchor_number == sent->anchor_number", "1"),
        ("(frame->from == sent->to ||", "(1 ||"),
    ],
    ids=lambda check: check[0],
)
def test_fuzzer_detects_an_exchange_without_one_of_its_checks(tmp_path: Path, check: tuple[str, str]):
    program = build(tmp_path, c_compiler(), broken=check)
    with pytest.raises(UwbMitigationError, match="exit -6"):
        run_tool([str(program), "300", "1"])


@pytest.mark.skipif(shutil.which("clang") is None, reason="no clang: apt install clang")
def test_brief_fuzzing_finds_no_failure(tmp_path: Path):
    program = build(tmp_path, ("clang",), "-fsanitize=fuzzer,address,undefined", "-DUWB_LIBFUZZER")
    options = ("-runs=1000", "-seed=1", "-max_len=8000", "-len_control=0")
    result = subprocess.run([program, *options], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr[-2000:]
