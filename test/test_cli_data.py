"""The commands `data import` and `data info`; stamps of imported recordings."""

import json
from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
from bag_material import START_NS, damage_after_first_chunk, record, write_bag
from command_line import run, start, succeed

from uwb_mitigation.recordings.bag.reader import BagReader
from uwb_mitigation.recordings.bag.writer import BagWriter
from uwb_mitigation.recordings.formats import open_recording
from uwb_mitigation.recordings.summary import PauseShortener
from uwb_mitigation.types.measurement import Cir, RangeMeasurement, Record
from uwb_mitigation.types.ros import codec


def test_info_shows_the_contents_of_a_bag(tmp_path: Path) -> None:
    write_bag(tmp_path / "bag.mcap", 6, simulated="true")
    done = start("data info bag.mcap --json info.json", folder=tmp_path)
    assert done.returncode == 0, done.stderr
    for shown in ("simulated", "6 ranges", "2 pairs", "NDP NLOS", "6.500", "7.000", "50.0"):
        assert shown in done.stdout
    result = json.loads((tmp_path / "info.json").read_text())
    assert (result["messages"], result["ranges"], result["pairs"]) == (12, 6, 2)
    assert result["duration_s"] == pytest.approx(0.05)
    assert result["skipped"] == {}
    assert result["simulated"] is True


def test_import_joins_recordings_and_keeps_the_simulated_mark(tmp_path: Path) -> None:
    write_bag(tmp_path / "one.mcap", 6, simulated="true")
    write_bag(tmp_path / "two", 3, simulated="true")
    succeed("data import one.mcap two -o out --json import.json", folder=tmp_path)
    bag = BagReader(tmp_path / "out")
    assert bag.message_count == 18
    assert bag.metadata["uwb_mitigation"]["simulated"] == "true"
    assert json.loads((tmp_path / "import.json").read_text())["ranges"] == 9


def test_damaged_bag_is_shown_up_to_the_damage_and_exits_1(tmp_path: Path) -> None:
    end = damage_after_first_chunk(write_bag(tmp_path / "bag.mcap", 6))
    done = run("data", "info", "bag.mcap", "--json", "info.json", folder=tmp_path)
    assert done.returncode == 1
    assert "6 ranges" in done.stdout
    assert f"bag.mcap, byte {end}" in done.stderr
    kept = run("data", "import", "bag.mcap", "-o", "kept.mcap", folder=tmp_path)
    assert kept.returncode == 1
    assert f"byte {end}" in kept.stderr
    assert BagReader(tmp_path / "kept.mcap").message_count == 12


@pytest.mark.parametrize(
    ("name", "content", "excerpt"),
    [
        ("absent.mcap", None, "no such file"),
        ("empty.mcap", b"", "empty"),
        ("notes.txt", b"notes", "DecaRanging"),
    ],
)
@pytest.mark.parametrize("words", ["data info", "data import -o out.mcap"])
def test_invalid_input_prints_one_line_and_exits_1(
    tmp_path: Path, name: str, content: bytes | None, excerpt: str, words: str
) -> None:
    if content is not None:
        (tmp_path / name).write_bytes(content)
    done = run(words, name, folder=tmp_path)
    assert done.returncode == 1
    (line,) = done.stderr.splitlines()
    assert name in line
    assert excerpt in line
    assert not (tmp_path / "out.mcap").exists()


def messages(record: Record) -> tuple[bytes, bytes]:
    return codec.encode_range(record.measurement), codec.encode_truth(record.measurement, record.truth)


def test_all_apartment_logs_become_one_bag(
    apartment: Path, apartment_imported: Path, apartment_reading: list[Record]
) -> None:
    result = json.loads((apartment_imported / "import.json").read_text())
    assert (result["pairs"], result["ranges"], result["with_truth"]) == (28, 4151, 4151)
    # A parser that reads the logs line by line counts the same.
    assert result["skipped"] == {
        "reception error": 131,
        "exchange without a range": 14,
        "range without a CIR": 2,
        "value that is not a number or out of range": 2,
    }
    printed = (apartment_imported / "printed.txt").read_text()
    assert all(kind in printed for kind in result["skipped"])
    with open_recording(apartment) as logs:
        for item, expected in zip(apartment_reading[::10], islice(logs, 0, None, 10), strict=True):
            assert messages(item) == messages(expected)


def test_import_shortens_pauses_by_default_and_reports_it(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "in.mcap", {"source": "a test"}) as bag:
        for stamp_ns in (10**18, 10**18 + 10**12):
            bag.write(Record(RangeMeasurement(stamp_ns, 5, 2, 0, 0, 4.5, Cir(np.zeros(2, np.int16)))))

    def span_s(*options: str) -> float:
        done = succeed("data", "import", "in.mcap", "-o", "out.mcap", "--force", *options, folder=tmp_path)
        assert ("Shortened 1 pauses to 5 s, 995 s in total" in done.stdout) is not bool(options)
        first, last = BagReader(tmp_path / "out.mcap").messages()
        assert BagReader(tmp_path / "out.mcap").metadata["uwb_mitigation"]["simulated"] == "unknown"
        return (last.log_time_ns - first.log_time_ns) / 1e9

    assert span_s() == 5.0
    assert span_s("--longest-pause", "inf") == 1000.0
    for limit in ("-1", "nan"):
        refused = run("data import in.mcap -o x.mcap --longest-pause", limit, folder=tmp_path)
        assert "inf cuts none" in refused.stderr
    assert "unknown whether" in run("data", "info", "out.mcap", folder=tmp_path).stdout


DAY_NS = 86_400 * 10**9
TODAY_NS = START_NS + 500 * DAY_NS


def moved(pauses: PauseShortener, *stamps_ns: int) -> list[int]:
    records = [replace(record(0), measurement=replace(record(0).measurement, stamp_ns=s)) for s in stamps_ns]
    return [pauses.without(item).measurement.stamp_ns for item in records]


def test_records_without_a_date_start_at_the_given_date_or_after_dated_records() -> None:
    assert moved(PauseShortener(5.0, TODAY_NS), 0, 10) == [TODAY_NS, TODAY_NS + 10]
    assert moved(PauseShortener(5.0, TODAY_NS), START_NS, 0, 10) == [START_NS, START_NS, START_NS + 10]
