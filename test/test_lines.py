"""Boards that print ranges as text: the source `lines`, and `pans` for a DWM1001 with its factory firmware."""

import logging
import signal
import socket
import time
import tracemalloc
from functools import partial
from pathlib import Path

import pytest
import ros_harness
from port_events import PortEvents, driver_values, wait_until
from ros_harness import diagnostic_values
from uwb_mitigation_msgs.msg import Cir, RangeCir

from benchmarks.equipment.emulated_board import PseudoTerminal
from benchmarks.equipment.text_board import KINDS, PansShell, TextBoards
from uwb_mitigation.errors import DamagedRecordingError, LinkError, RecordingError
from uwb_mitigation.mitigation.model.choice import CirKind, choose_model
from uwb_mitigation.mitigation.model.shipped import load_model
from uwb_mitigation.nodes.support.parameter_tables import RESPAWN_FOLDER
from uwb_mitigation.radios import lines, uci
from uwb_mitigation.radios.lines import LineSession
from uwb_mitigation.radios.settings import PortMessage
from uwb_mitigation.recordings.mapping.mapped import MappedRecording
from uwb_mitigation.recordings.mapping.mapping import FieldRule, Mapping, load_mapping
from uwb_mitigation.types.measurement import RangeMeasurement

MAPPINGS = {"pans": "dwm1001_pans", "at": "string_at", "json": "string_json", "cli": "dwm3001_cli"}
LEC = "DIST,2,AN0,022E,7.94,8.03,0.00,3.44,AN1,9280,7.95,0.00,-1.20,15.68,POS,6.95,5.37,-1.97,52"
LES = "022E[7.94,8.03,0.00]=3.44 9280[7.95,0.00,-1.20]=15.68 le_us=3082 est[6.97,5.17,-1.77,53]"
GOOD = '{"tag": 7, "ranges": [{"anchor": 1, "range_m": 4.31}]}'
S = 10**9
value_of = partial(driver_values, source="lines")


def read(session: LineSession, text: str | bytes, stamp_ns: int = 5) -> list[tuple[int, int, float]]:
    data = text.encode() if isinstance(text, str) else text
    return [(m.tag_id, m.anchor_id, round(m.range_m, 4)) for m in session.receive(data, 0, stamp_ns)]


def session_of(name: str, number: int = 0) -> LineSession:
    session = LineSession(load_mapping(name), number)
    assert read(session, "the rest of a line\n") == []
    assert session.counts["lines"] == 0
    return session


FIRST, SECOND = (0x022E, 3.44), (0x9280, 15.68)


@pytest.mark.parametrize(
    ("line", "ranges"),
    [
        *((line, [FIRST, SECOND]) for line in (LEC, LES, f"dwm> {LES}", LEC.partition(",POS")[0])),
        (LEC.replace("15.68", "15.6"), [FIRST]),
        (LEC.replace("3.44", "344"), [SECOND]),
        (LEC[:70] + LEC, [FIRST, FIRST, SECOND]),
        (LEC.replace("022E,", "022E"), [SECOND]),
        ("POS,6.95,5.37,-1.97,52", []),
    ],
)
def test_shell_commands_of_a_dwm1001_are_read_and_cut_lines_give_no_wrong_range(line: str, ranges: list):
    # Without an id of its own, a board has the number of its port.
    assert read(session_of("dwm1001_pans", 2), line + "\r\n") == [(3, *found) for found in ranges]


def test_lines_of_own_firmware_may_contain_the_cir():
    fields = {"anchor": "anchor", "range": "range", "first_path_index": "fp"}
    text = {
        "name": "own",
        "pattern": r"R (?P<anchor>\d+) (?P<range>\S+) (?P<fp>\S+) (?P<cir>[-\d,]+)",
        "fields": fields,
    }
    cir = {"cir": {"column": "cir", "samples": "interleaved"}, "radio": "DW3000", "segment": "IPATOV"}
    session = LineSession(Mapping(**text, **cir))
    (measured,) = session.receive(b"\nR 3 5.02 1.25 7,-8,4000,3000\n", 0, 5)
    assert (measured.anchor_id, measured.range_m, measured.cir.first_path_index) == (3, 5.02, 1.25)
    assert measured.cir.samples.tolist() == [7, -8, 4000, 3000]
    # As the pages say: no shipped model was trained for the preamble of a DW3000.
    assert not choose_model(load_model(), CirKind.of(measured.cir)).fits


def test_a_timeout_of_the_cli_image_is_counted_and_not_a_range():
    session = session_of("dwm3001_cli")
    text = ' [mac_address=0x0001, status="SUCCESS", distance[cm]=245, loc_az=1.5, RSSI[dBm]=-66.5];\r\n'
    assert read(session, text + ' [mac_address=0x0002, status="RX_TIMEOUT"]}\r\n') == [(1, 1, 2.45)]
    text = '{"Block":1, "results":[{"Addr":"0xdc4c","Status":"Ok","D_cm":42}]}\n'
    assert read(session, text) == [(1, 0xDC4C, 0.42)]
    assert session.counts["status differs ['SUCCESS', 'Ok']"] == 1
    assert session.counts["lines that do not match"] == 0


def test_hostile_bytes_are_counted_and_the_next_line_is_read():
    session = session_of("string_json", 2)
    good = f"{GOOD}\n"
    hostile = [b"\xff\xfe\x00\x01", b"[" * 60_000, b"x" * 300_000, b"9" * 5000, b'"x"', b"null"]
    hostile += [good[:30].encode()]
    hostile += [good.replace("7", "1").replace("4.31", value).encode() for value in ("[1]", '"a"', "{}")]
    for data in hostile:
        assert read(session, data) == []
        assert read(session, b"\n" + good.encode()) == [(7, 1, 4.31)]
    values = ("NaN", "1e400", "-Infinity", "1e30", "null")
    ranges = ",".join(f'{{"anchor": {n}, "range_m": {value}}}' for n, value in enumerate(values))
    assert read(session, f'{{"tag": 7, "ranges": [{ranges}]}}\n') == []
    assert session.counts["range is not a number"] + session.counts["range is above 10000"] == len(values)
    assert (session.counts["lines that do not match"], session.counts["lines that are too long"]) == (9, 1)
    assert session.example.startswith('\'{"tag": 1, "ranges": [')
    tracemalloc.start()
    for _ in range(100):
        assert read(session, b"x" * lines.MAX_LINE) == []
    held, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert held < 3 * lines.MAX_LINE, "the rest of an endless line"


@pytest.mark.parametrize("name", MAPPINGS.values())
@pytest.mark.parametrize(
    "text", ["a", "0", "a:", "a: (", "{", " ", "AN0,", "0.00,", "mac_address=0x1,", "022E["]
)
def test_a_long_line_takes_no_more_steps_than_its_length(name: str, text: str):
    # A search that is quadratic would take minutes.
    session = session_of(name)
    assert read(session, text * (60_000 // len(text)) + "\n" + LEC[:5] + "\n") == []
    assert session.counts["lines"] == 1 + bool(text.strip())


def test_the_stamp_is_that_of_the_first_byte_unless_the_mapping_gives_a_time():
    session = session_of("string_json")
    assert read(session, GOOD[:20], 100) == []
    stamps = [m.stamp_ns for m in session.receive(f"{GOOD[20:]}\n{GOOD}\n{GOOD}".encode(), 0, 200)]
    stamps += [m.stamp_ns for m in session.receive(b"\n", 0, 300)]
    assert stamps == [100, 200, 200]
    document = {"name": "x", "pattern": r"(?P<t>\d+) (?P<a>\d+) (?P<r>[\d.]+)"}
    fields = {"stamp": {"column": "t", "unit": "ms"}, "anchor": "a", "range": "r"}
    timed = LineSession(Mapping.model_validate(document | {"fields": fields}), has_datagrams=True)
    assert [m.stamp_ns for m in timed.receive(b"7000 2 1.5", 0, 100 * S)] == [7 * S]
    assert timed.stamp_offset_s == -93.0


def test_a_log_and_a_live_port_give_the_same_ranges(tmp_path: Path):
    text = f"dwm> lec\n{LEC}\nnoise\n{LEC.replace('3.44', '3.45')}\n"
    path = tmp_path / "lec.log"
    path.write_text(text)
    mapping = load_mapping("dwm1001_pans")
    fields = mapping.fields.model_copy(update={"stamp": FieldRule(rate_hz=10)})
    log = MappedRecording(timed := mapping.model_copy(update={"fields": fields}), path)
    recorded = [(r.measurement.anchor_id, r.measurement.range_m) for r in log]
    session = LineSession(timed, has_datagrams=True)
    live = [(m.anchor_id, m.range_m) for m in session.receive(text.encode(), 0, 7 * S)]
    assert (recorded, len(recorded)) == (live, 4)
    assert session.stamp_offset_s == 0.0, "the number of the row is no time of a live line"
    assert log.anchors.anchors[log.anchors.index[0x9280]].position == (7.95, 0.0, -1.2)


def open_board(port: Path | str, kind: str, capture: Path | str = "") -> PortEvents:
    values = value_of(port=str(port), map=MAPPINGS[kind], capture=str(capture))
    return PortEvents(lines, *lines.read_settings(values))


@pytest.mark.parametrize("kind", KINDS)
def test_a_board_vanishes_and_returns(tmp_path: Path, kind: str):
    emulated = TextBoards(kind, links=tmp_path / "b", rate_hz=50.0)
    with emulated as boards, open_board(tmp_path / "b0", kind) as events:
        (message,) = events.wait_for(PortMessage)
        assert "ranges of tag" in message.text
        events.wait_for(lambda event: isinstance(event, RangeMeasurement) and event.range_m > 0, 8)
        boards.inject(0, b"\xff\x00garbage\r\n" + b"A" * 100_000 + b"\n")
        boards.unplug(0)
        wait_until(lambda: "not there" in events.port.report().problem)
        boards.plug(0)
        wait_until(lambda: not events.port.problem)
        measured = events.wait_for(RangeMeasurement, 8)
        assert {round(m.range_m) for m in measured} <= {round(true) for true in boards.true_ranges_m}
        # Ranges that were received before may have waited in a queue.
        wait_until(lambda: events.port.report().warning == "")


@pytest.mark.parametrize(
    ("state", "options", "silent_s"),
    [
        *((state, {}, 0.0) for state in ("generic", "shell", "lec", "les")),
        *((state, {"banner": ""}, 5.0) for state in ("generic", "lec")),
    ],
)
def test_the_output_of_a_dwm1001_is_on_in_whatever_state_it_was(state: str, options: dict, silent_s: float):
    """In virtual time: possibly silent at first; later someone turns its output off; then it is reset."""
    session, shell, now_ns = LineSession(load_mapping("dwm1001_pans")), PansShell(**options), 0
    if state != "generic":
        shell.receive(b"\r\r", 0.0)
        shell.output = state if state != "shell" else ""
    session.opened(0)

    def run(seconds: float, line: str = f"{LEC}\r\n") -> list[RangeMeasurement]:
        nonlocal now_ns
        ranges: list[RangeMeasurement] = []
        for _ in range(round(seconds * 10)):
            now_ns += S // 10
            answer = shell.receive(session.outgoing(), now_ns / S)
            ranges += session.receive(answer + (line.encode() if shell.output else b""), now_ns, now_ns)
        return ranges

    run(silent_s, line="")
    assert len(run(10.0)) > 100
    if silent_s == 0.0:
        assert session.counts["starts of the output"] == (state in ("generic", "shell"))
    run(10.0, line="")
    assert shell.output, "the output of a tag that is silent for a while is not turned off"
    shell.output = ""
    assert len(run(40.0)) == 0
    assert len(run(40.0)) > 20
    shell = PansShell(**options)
    assert len(run(80.0)) > 20


def test_a_board_without_ranges_is_explained(ros: ros_harness.Ros, tmp_path: Path):
    terminal = PseudoTerminal(tmp_path / "b0")
    terminal.plug()
    driver = ros.start("driver", "source:=lines", "map:=string_at", f"port:={tmp_path}/b0")
    driver.wait_for_output("no range in 5 s: no range yet: nothing was received; is the baud rate 115200")
    assert driver.signal(signal.SIGINT) == 0
    with open_board(tmp_path / "b0", "at") as events:
        wait_until(lambda: events.port.device)
        assert "no range yet: nothing was received; is the baud rate 115200" in events.port.report().warning
        terminal.write(bytearray(b"x\nrst:0x1 (POWERON_RESET)\n"))
        text = "do not match the mapping AT+RANGE, such as 'rst:0x1"
        wait_until(lambda: text in events.port.report().warning)
        assert events.port.report().values["lines that do not match"] == 1
    terminal.unplug()


def test_a_port_without_data_is_opened_again_but_not_that_of_a_tag_that_reports_once_a_minute():
    port = lines.LinePort(
        *lines.read_settings(value_of(source="pans", port="/dev/no")), (0, None, print, lambda: 0)
    )
    assert port._received(b"", 65 * S, 0) == []
    with pytest.raises(LinkError, match="sends no data"):
        port._received(b"", 71 * S, 0)


def test_datagrams_are_received(tmp_path: Path):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        place = probe.getsockname()
    port = f"udp:{place[0]}:{place[1]}"
    with TextBoards("json", udp=place, rate_hz=50.0), open_board(port, "json") as events:
        events.wait_for(RangeMeasurement, 8)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            for data in (b"", b"\xff" * 60_000, b'{"tag": 9, "ranges": [{"anchor": 3, "range_m": 1.5}]}'):
                sender.sendto(data, place)
        (measured,) = events.wait_for(lambda event: getattr(event, "tag_id", 0) == 9)
        assert (measured.range_m, events.port.openings) == (1.5, 1)
        with open_board(port, "json") as second:
            wait_until(lambda: f"{port}: cannot be opened: Address already in use" in second.port.problem)


def test_a_capture_replays_the_ranges_also_with_another_mapping(tmp_path: Path):
    path = tmp_path / "capture.txt"
    boards = TextBoards(links=tmp_path / "b", rate_hz=50.0)
    with boards, open_board(tmp_path / "b0", "pans", capture=path) as events:
        measured = events.wait_for(RangeMeasurement, 40)
    replayed = [r.measurement.range_m for r in lines.open_capture(path, value_of())]
    assert replayed[:40] == [m.range_m for m in measured]
    assert b"lec".hex() in path.read_text()
    assert not list(lines.open_capture(path, value_of(map="string_at")))
    with pytest.raises(RecordingError, match="not a capture of source uci"):
        uci.open_capture(path)
    path.write_text('# uwb_mitigation lines capture 1\nboard 0 {"mapping": 3}\n')
    with pytest.raises(DamagedRecordingError):
        list(lines.open_capture(path, value_of()))


def test_a_full_disk_ends_the_capture_but_not_the_ranges(tmp_path: Path):
    boards = TextBoards(links=tmp_path / "b", rate_hz=50.0)
    with boards, open_board(tmp_path / "b0", "pans", capture=Path("/dev/full")) as events:
        (message,) = events.wait_for(lambda event: "capture" in getattr(event, "text", ""))
        text = "the capture has ended: No space left on device"
        assert (message.level, message.text) == (logging.ERROR, text)
        events.wait_for(RangeMeasurement, 3)
        assert events.port.openings == 1


@pytest.mark.ros
def test_driver_publishes_the_ranges_of_two_dwm1001s(
    ros: ros_harness.Ros, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    # The driver was respawned, and must not replace the capture of the crash.
    monkeypatch.setenv(RESPAWN_FOLDER, str(tmp_path))
    for name in ("driver.run", "c.txt"):
        (tmp_path / name).touch()
    raw = ros.collect(RangeCir, "/uwb/range_raw")
    with TextBoards(boards=2, links=tmp_path / "b") as boards:
        began = time.time()
        ports = f"port:={tmp_path}/b0,{tmp_path}/b1"
        node = ros.start("driver", "source:=pans", ports, f"capture:={tmp_path}/c.txt")
        ros.spin_until(lambda: {message.tag_id for message in raw} == {1, 2} and len(raw) > 40)
        message = next(message for message in raw if message.anchor_id == 0x9280)
        assert message.range == pytest.approx(boards.true_ranges_m[1], abs=0.15)
        assert (len(message.cir.samples), message.header.stamp.sec >= int(began)) == (0, True)
        assert message.cir.radio == Cir.UNKNOWN
        status = ros.diagnosis("driver", lambda status: status.message == "receiving")
        assert diagnostic_values(status)["radio 1: mapping"] == "DWM1001 PANS"
        assert node.output.count("DWM1001 PANS at /") == 2
        assert node.signal(signal.SIGINT) == 0, node.output
    raw.clear()
    ros.start("driver", "source:=pans", f"path:={tmp_path}/c_2.txt", "rate:=20.0")
    ros.spin_until(lambda: len(raw) > 40)
