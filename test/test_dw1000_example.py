"""The programs in C that show how to use the DW1000's model: the page's, and the example's own driver, which ranges."""

from __future__ import annotations

import re
import subprocess
from pathlib import Path

import pytest
from compilers import NEEDS_CC
from conftest import REPOSITORY

from benchmarks.dw1000_model.library import model_folder, model_objects
from uwb_mitigation.firmware_export.compiling import WARNINGS, c_compiler, run

pytestmark = NEEDS_CC


def test_a_driver_may_define_any_name_without_the_models_prefix(tmp_path: Path):
    objects = model_objects()
    defined = run(["nm", "-g", "--defined-only", "-P", *objects]).splitlines()
    names = [line.split()[0] for line in defined if not line.endswith(":")]
    assert len(names) > 50
    assert [name for name in names if not name.startswith("dw1000_")] == []
    short = sorted({"get", "put", "wake", "control", *(name.removeprefix("dw1000_") for name in names)})
    driver = tmp_path / "driver.c"
    driver.write_text(
        "".join(f"int {name}(void);\nint {name}(void) {{ return 0; }}\n" for name in short)
        + '#include "dw1000_model.h"\nint main(void) { dw1000_air_free(dw1000_air_new(1)); return 0; }\n'
    )
    program = tmp_path / "driver"
    options = ("-fno-builtin", f"-I{model_folder()}")
    run([*c_compiler(), *options, str(driver), *objects, "-lm", "-lpthread", "-o", str(program)])
    run([str(program)])


def compiled(source: Path, program: Path) -> Path:
    sources = (*model_folder().glob("*.c"), source)
    options = ("-std=c11", "-O1", "-g", "-fsanitize=address,undefined", *WARNINGS, f"-I{model_folder()}")
    run([*c_compiler(), *options, *map(str, sources), "-lm", "-lpthread", "-o", str(program)])
    return program


@pytest.fixture(scope="module")
def two_way(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return compiled(model_folder() / "example" / "two_way.c", tmp_path_factory.mktemp("example") / "two_way")


@pytest.mark.parametrize("distance_m", [0.3, 3.3, 100.0])
def test_the_example_measures_its_link(two_way: Path, distance_m: float):
    done = subprocess.run([two_way, str(distance_m), "20"], capture_output=True, text=True, check=False)
    found = re.fullmatch(r"20 ranges in 0.150 s of virtual time, mean (\S+) m\n", done.stdout)
    assert found, done.stdout + done.stderr
    assert float(found[1]) == pytest.approx(distance_m, abs=0.003)


def test_the_pages_program_prints_what_the_page_says(tmp_path: Path):
    page = (REPOSITORY / "docs" / "dw1000_model.md").read_text(encoding="utf-8")
    (text,) = re.findall(r"```c\n(.*?)```", page, re.DOTALL)
    (promise,) = re.findall(r"prints `(.*?)` twice", page)
    source = tmp_path / "blink.c"
    source.write_text(text, encoding="utf-8")
    done = subprocess.run([compiled(source, tmp_path / "blink")], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines() == [promise] * 2
