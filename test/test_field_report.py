"""`uwb-mitigation field-report` with emulated boards, and injected faults."""

import getpass
import json
import math
import re
import socket
import subprocess
import sys
import threading
import time
import zipfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from compilers import NEEDS_CC
from port_events import driver_values
from typer.testing import CliRunner

from benchmarks.equipment.dw1000_model.evb1000 import EmulatedEvb1000s
from benchmarks.equipment.emulated_board import PseudoTerminal
from benchmarks.equipment.text_board import TextBoards
from benchmarks.equipment.uci_board import EmulatedUciBoards, UciFaults
from uwb_mitigation.commands import cli, field_report
from uwb_mitigation.commands.field.checks import Observation, Verdict, run_checks
from uwb_mitigation.radios import lines, uci
from uwb_mitigation.radios.evb1000 import Evb1000Bus
from uwb_mitigation.recordings.mcap import McapRecording
from uwb_mitigation.types.measurement import Cir, RangeMeasurement

Report = Callable[..., dict[str, dict]]


@pytest.fixture
def report(tmp_path: Path) -> Report:
    """Return the checks of a report, {name: check}."""

    def run(source: str, ports: int = 2, *options: str) -> dict[str, dict]:
        names = ",".join(str(tmp_path / f"{source}{number}") for number in range(ports))
        command = ["field-report", "--source", source, "--port", names, "--distance", "3.0", "--seconds", "2"]
        files = ["--force", "-o", str(tmp_path / "out.zip"), "--json", str(tmp_path / "out.json")]
        result = CliRunner().invoke(cli.app, [*command, *files, *(options or ("--no-unplug",))])
        checks = json.loads((tmp_path / "out.json").read_text())["checks"]
        by_name = {check["name"]: check for check in checks}
        remedies = [check["remedy"] for check in checks if check["verdict"] != "pass"]
        assert [remedy for remedy in remedies if remedy not in result.output] == []
        assert "0xdeca" in result.output or source != "evb1000"
        assert result.exit_code == (1 if failed(by_name) else 0), (result.output, result.exception)
        return by_name

    return run


def failed(checks: dict[str, dict]) -> set[str]:
    return {name for name, check in checks.items() if check["verdict"] == "fail"}


def test_good_uci_boards_pass_and_the_file_names_nobody(report: Report, tmp_path: Path, monkeypatch):
    with EmulatedUciBoards(links=tmp_path / "uci") as boards:

        def replug(_: str) -> None:
            def act() -> None:
                boards.unplug(0)
                time.sleep(0.6)
                boards.plug(0)

            threading.Thread(target=act).start()

        monkeypatch.setattr(field_report, "_ask", replug)
        checks = report("uci", 2, "--unplug", "--seconds", "3")
    assert not failed(checks)
    assert checks["model"]["verdict"] == "warning"
    assert checks["read back: CIR taps"]["value"] == "157"
    assert "recovery after reconnecting" in checks
    assert checks["warnings of the driver"]["value"] == "none"
    page = zipfile.Path(tmp_path / "out.zip", "report.html").read_text()
    assert b"emulated".hex() in page
    assert "the release of the kernel" in page
    assert "calibration writes" in page
    with zipfile.ZipFile(tmp_path / "out.zip") as archive:
        assert set(archive.namelist()) == {"capture.txt", "ranges.mcap", "report.html", "report.json"}
        archive.extractall(tmp_path / "out")
        contents = {name: archive.read(name).decode("latin1") for name in archive.namelist()}
    # What is the same in every page; an account may be named as an attribute of it.
    shared = r"<script>.*?</script>|<style>.*?</style>|data-root-id"
    contents["report.html"] = re.sub(shared, "", page, flags=re.DOTALL)
    assert "Last CIR" in contents["report.html"]
    for name, text in contents.items():
        for secret in (str(tmp_path), str(Path.home()), "/dev/"):
            assert secret not in text
        if not name.endswith(".mcap"):  # compressed bytes may contain a short name by chance
            assert not re.search(rf"\b({socket.gethostname()}|{getpass.getuser()})\b", text)
    assert len(list(uci.open_capture(tmp_path / "out" / "capture.txt"))) > 5
    records = list(McapRecording(tmp_path / "out" / "ranges.mcap"))
    assert len(records) > 5
    assert records[0].truth.range_m == 3.0


def test_faults_of_uci_boards_are_detected_and_nobody_has_to_unplug_one(
    report: Report, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr("uwb_mitigation.commands.field.test.UNPLUG_TIMEOUT_S", 0.5)
    faults = UciFaults(offset_m=0.5, clock_ppm=60.0)
    with EmulatedUciBoards(links=tmp_path / "uci", faults=faults, rejects=frozenset([0x2D])):
        checks = report("uci", 2, "--unplug")
    errors = {"error of the median range", "error of the median corrected range"}
    assert failed(checks) == {*errors, "clock error"}
    rejected = "BLOCK_STRIDE_LENGTH (0x2d): invalid parameter (status 0x04)"
    assert rejected in checks["warnings of the driver"]["value"]
    recovery = checks["recovery after reconnecting"]
    assert (recovery["verdict"], recovery["value"]) == ("warning", "not unplugged")


def test_board_without_cirs_has_no_check_of_them(report: Report, tmp_path: Path):
    with TextBoards(links=tmp_path / "pans", distance_m=3.0):
        checks = report("pans", 1, "--no-unplug", "--seconds", "3")
    assert not failed(checks)
    assert "share of ranges with CIR" not in checks
    assert checks["ids"]["value"] == "tag 1, anchor 558"
    with zipfile.ZipFile(tmp_path / "out.zip") as archive:
        archive.extract("capture.txt", tmp_path)
    assert len(list(lines.open_capture(tmp_path / "capture.txt", driver_values(source="lines")))) > 10


@NEEDS_CC
def test_only_the_low_supply_of_good_evb1000s_fails(report: Report, tmp_path: Path, monkeypatch):
    # On a busy machine, the emulated boards answer too late for the delays of real ones.
    monkeypatch.setattr(Evb1000Bus, "reply_us", 100_000)
    monkeypatch.setattr(Evb1000Bus, "timeout_us", 400_000)
    monkeypatch.setattr(field_report, "_write", lambda *_: None)
    with EmulatedEvb1000s(None, port_links=tmp_path / "evb1000") as boards:
        boards._boards[0].chip.set_environment(30.0, 2.6)
        # On a busy machine, the emulated boards answer some requests too late: each check passes once, and rarely all together.
        checks = report("evb1000")
        never_passed = failed(checks)
        for _ in range(20):
            if never_passed - {"supply"}:
                never_passed &= failed(report("evb1000"))
        assert never_passed == {"supply"}
        assert checks["read back: device id"]["value"] == "0xdeca0130"
        assert checks["read back: antenna delay (15.65 ps)"]["verdict"] == "pass"


def test_negative_distances_are_named_with_their_cause(report: Report, tmp_path: Path, monkeypatch):
    monkeypatch.setattr("uwb_mitigation.commands.field.test.START_TIMEOUT_S", 8.0)
    with EmulatedUciBoards(links=tmp_path / "uci", distance_m=0.2, faults=UciFaults(offset_m=-0.3)):
        check = report("uci")["failed exchanges: negative distance"]
    assert check["verdict"] == "fail"
    assert "antenna delay" in check["remedy"]


def test_absent_port_is_reported_before_slow_imports(tmp_path: Path):
    words = ["field-report", "--source", "uci", "--port", str(tmp_path / "no"), "--distance", "3"]
    code = f"import sys; from uwb_mitigation.commands import cli; sys.argv[1:] = {words}; cli.main()"
    code = f"import atexit, sys; atexit.register(lambda: print('numpy' in sys.modules)); {code}"
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert f"{tmp_path / 'no'}: is not there (connect the board)" in ended.stderr
    assert (ended.stdout, ended.returncode) == ("False\n", 1)


def test_silent_board_gives_a_report(report: Report, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("uwb_mitigation.commands.field.test.START_TIMEOUT_S", 1.0)
    terminal = PseudoTerminal(tmp_path / "uci0")
    terminal.plug()
    checks = report("uci", 1)
    terminal.unplug()
    assert {"problem of the driver", "ranges per second", "ids"} <= failed(checks)
    assert "no answer to the reset" in checks["problem of the driver"]["value"]
    page = zipfile.Path(tmp_path / "out.zip", "report.html").read_text()
    assert re.search(r"\d{4}-\d\d-\d\d \d\d:\d\d UTC; 0 ranges at 3.00 m in 2 s", page)
    with zipfile.ZipFile(tmp_path / "out.zip") as archive:
        for name in archive.namelist():
            assert tmp_path.name.encode() not in archive.read(name)


@pytest.mark.parametrize(
    ("options", "message"),
    [(("-o", "earlier.zip"), "exists already"), (("-o", "earlier.zip", "--force"), "is not there")],
)
def test_invalid_options_are_refused(options: tuple[str, ...], message: str, tmp_path: Path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("a", "b", "c", "earlier.zip"):
        Path(name).touch()
    command = ["field-report", "--source", "uci", "--port", "/dev/a", "--distance", "3", *options]
    result = CliRunner().invoke(cli.app, command)
    assert result.exit_code
    assert message in f"{result.output} {result.exception}"


NO_CIR = Cir(np.zeros(0, np.int16))
RANGE = RangeMeasurement(0, 1, 2, 0, 0, 3.0, Cir(np.tile(np.int16([3, -3]), 20), first_path_index=5.0))


@pytest.mark.parametrize(
    ("change", "name"),
    [
        ({"written": {"channel": 5}, "read": {"channel": 9}}, "read back: channel"),
        ({"expected_ids": (2, 1)}, "ids"),
        ({"temperature_c": 95.0}, "temperature"),
        ({"voltage": 2.6}, "supply"),
        ({"clock_offset_ppm": -60.0}, "clock error"),
        ({"ranges": [replace(RANGE, cir=NO_CIR)] * 100}, "share of ranges with CIR"),
        ({"unplugged": True}, "recovery after reconnecting"),
        ({"failures": {"STS error": 900}}, "failed exchanges: STS error"),
        ({"damaged": 500}, "damaged packets per range"),
        ({"ranges": []}, "ranges per second"),
        ({"problem": "lost"}, "problem of the driver"),
        ({"distance_m": math.nan}, "error of the median range"),
    ],
)
def test_a_check_fails(change: dict, name: str):
    good = Observation(
        3.0, 1.0, (1, 2), voltage=3.3, ranges=[replace(RANGE, stamp_ns=number) for number in range(100)]
    )
    before = {check.name: check.verdict for check in run_checks(good)}
    assert before.get(name) in (None, Verdict.PASS)
    after = {check.name: check.verdict for check in run_checks(replace(good, **change))}
    assert after[name] is Verdict.FAIL


def test_texts_are_anonymised():
    text = f"/dev/ttyACM0: in use by x; {Path.home()}/a b; host {socket.gethostname()}; 60 Hz, a/b"
    cleaned = field_report.anonymise(text)
    assert "/dev/" not in cleaned
    assert not re.search(rf"\b{socket.gethostname()}\b", cleaned)
    assert cleaned.endswith("60 Hz, a/b")
    problem = "/data/ann b/uci 0 was lost: [Errno 5] '/scratch/ann/uci1', //srv/ann and ports/uci2"
    cleaned = field_report.anonymise(problem, ["/data/ann b/uci 0", "ports/uci2"])
    assert "ann" not in cleaned
    assert "uci" not in cleaned
    assert "was lost: [Errno 5]" in cleaned
