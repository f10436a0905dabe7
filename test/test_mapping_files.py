"""Files as people have them: damaged, in other encodings and units, logs, several clocks; what is reported of them."""

import gzip
import json
import lzma
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from command_line import succeed
from pydantic import ValidationError
from scipy.io import savemat
from test_mapping import (
    BOOT,
    MESSAGE,
    PARTS,
    PLAIN,
    cirs_of,
    of,
    ranges_of,
    read,
    values_of,
    with_fields,
    write,
)

from uwb_mitigation.commands.support.mapped_report import models_of
from uwb_mitigation.errors import DamagedRecordingError, MissingDependencyError, RecordingError
from uwb_mitigation.mitigation.model.choice import CirKind
from uwb_mitigation.recordings import text_blocks
from uwb_mitigation.recordings.formats import open_mapped
from uwb_mitigation.recordings.live_ranges import LiveConverter
from uwb_mitigation.recordings.mapping.mapping import Mapping, load_mapping
from uwb_mitigation.types.measurement import RadioType, Segment

HEADER = "t,a,r,true\n"
TRUE = {"truth": {"range": "true"}}
TDOA = "t,a,r\n" + "".join(f"{n / 10},{n % 4},{2 * np.sin(n):.3f}\n" for n in range(60))


def rows(count: int = 80, start: float = 0.0, step: float = 0.1, factors: Any = None) -> str:
    """Return ranges of four anchors with errors of 0.1 m; `factors`: {anchor: of another unit}."""
    lines = []
    for n in range(count):
        anchor, true = n % 4 + 1, n % 4 + 3 + np.sin(n / 9)
        measured = (true + 0.1) * (factors or {}).get(anchor, 1)
        lines.append(f"{start + n * step:.6f},{anchor},{measured:.5f},{true:.5f}\n")
    return "".join(lines)


def every(step_s: float) -> str:
    """Return ranges in equal intervals."""
    return "t,a,r\n" + "".join(f"{n * step_s:.9f},1,2\n" for n in range(50))


def in_unit(unit: str) -> Any:
    return with_fields(stamp={"column": "t", "unit": unit})


AMPLITUDES = {"cir": {"column": "cir", "samples": "magnitude"}}


def with_cir(samples: Iterable[float]) -> str:
    return f't,a,r,cir\n0,2,3.0,"{" ".join(map(str, samples))}"\n'


@pytest.mark.parametrize(("suffix", "compress"), [("gz", gzip.compress), ("xz", lzma.compress)])
def test_rows_before_the_damage_of_a_packed_file_are_used(suffix: str, compress: Any, tmp_path: Path):
    text = "t,a,r\n" + "".join(f"{n},1,{np.sin(n) + 3:.9f}\n" for n in range(8_000))
    packed = compress(text.encode())
    source = of(packed[: len(packed) * 2 // 3], tmp_path / f"x.csv.{suffix}", moving=False)
    assert 2_000 < len(source) < 6_000
    found = []
    with pytest.raises(DamagedRecordingError, match=f"after row {len(source)}: truncated"):
        found.extend(record.measurement.range_m for record in source)
    assert found == pytest.approx([np.sin(n) + 3 for n in range(len(source))], abs=1e-8)


@pytest.mark.parametrize("encoding", ["utf-16", "utf-8-sig", "cp1252"])
def test_other_encodings_and_line_breaks_are_read(encoding: str, tmp_path: Path):
    text = "t;a;r;Gerät\r\n0,0;1;2,5;Küche\r\n0,1;2;2,6;Büro\r\n"
    document = {"separator": ";", "decimal": ",", "truth": {"label": "Gerät"}}
    source = of(text.encode(encoding), tmp_path / "x.csv", **document)
    assert values_of(source) == [(0.0, 1, 1, 2.5), (0.1, 1, 2, 2.6)]
    assert source.values["label"].tolist() == ["Küche", "Büro"]


def test_repeated_headers_and_merged_rows_are_dropped_and_keep_the_row_numbers(tmp_path: Path):
    write(tmp_path / "cirs.csv", "c\n" + "".join(f"{n} {n}\n" for n in range(6)))
    text = "t,a,r\n0,1,2.0\n0.1,1,2.10.2,1,2.2\nt,a,r\n0.3,1,2.3\n0.4,1,2.4\n"
    source = of(text, tmp_path / "x.csv", cir={"files": "cirs.csv", "column": "c"})
    assert ranges_of(source) == [2.0, 2.3, 2.4]
    assert cirs_of(source) == [[0, 0], [3, 3], [4, 4]]
    ((reason, count),) = source.dropped.items()
    assert (reason[:17], count) == ("a repeated header", 2)


@pytest.mark.parametrize(
    ("text", "document", "message"),
    [
        ("t,a,rng\n0,1,2\n", {}, r"no column r(; did you mean 'rng'\?)? \(columns: t, a, rng"),
        ("t,a,r\n0,1,2\n0.1,A7,2\n", {}, r"row 2: anchor = 'A7' is not an id"),
        ("t,a,r\n0,-1,2\n", {}, "anchor = -1 is not an id"),
        ("t,a,r\n0,A7,2\n", with_fields(anchor={"column": "a", "pattern": r"B(\d)"}), "1: anchor = 'A7' does not match 'B"),
        ("t,a,r\n0,10,2\n1,11,2\n2,1e2,2\n", {}, "row 3: anchor = '1e2' is not an id .*`hex: true`"),
        ("t,a,r\n0,1,4700\n1,1,4800\n", {}, "median range is 4,750 m .*set unit: mm"),
        ("t,a,r\n0,1,2\n", with_fields(range={"column": "r", "unit": "mm"}), "median range is 0.0020 m .*set unit: m"),
        ("t,a,r,true\n0,1,2,1900\n1,1,3,2900\n", TRUE, r"median true range is 2,400 m .*unit: mm"),
        ("t,a,r\n0,1,two\n", {}, "row 1: range = 'two' is not a number"),
        ("t,a,r\n0,1,2.5 m\n", {}, r"set pattern: '\(\[-\\d.\]\+\)'"),
        ("t,a,r\n0,1,nan\n", {}, "no ranges .*range is not a number"),
        ('t,a,r\n0,1,"4,7"\n', {}, "range = '4,7' is not a number .*decimal: ','"),
        (TDOA, {}, r"of the ranges are negative .*\(TDoA\)"),
        ("t,a,r,i\n0,1,2,46350\n", with_fields(first_path_index="i"), "first_path_index is 46,350 samples.*unit: '10.6'"),
        ("t,a,r\nyesterday,1,2\n", in_unit("iso8601"), "stamp = 'yesterday' is not a date"),
        ("t,a,r\n1700000000000,1,2\n", {}, "stamp = 1700000000000 is outside .*unit: ms"),
        ("t,a,r\n1700000000000000,1,2\n", in_unit("ms"), r"1824 to 2115 \(unit: us\)"),
        ("t,a,r\n2024-06-09T19:39:13,1,2\n", {}, "is not a number .*dates: set unit: iso8601"),
        ("t,a,r\n31/12/2023 10:00:00,1,2\n", {}, "set unit: '%d/%m/%Y %H:%M:%S', in the order of the file"),
        ("t,a,r\n10:00:00.5,1,2\n", {}, "set unit: iso8601"),
        ("t,a,r\n" + "5,1,2\n5,1,3\n" * 9, {}, r"all stamps are equal \(stamp: another column, or {rate_hz"),
        ("t;a;r\n0;1;2\n", {}, "there is one column 't;a;r'; set separator: ';'"),
        ("t,a,r,r\n0,1,2,3\n", {}, r"several columns have the name r \(columns: \[t, a, r, r.1\] and skip: 1"),
        ("t,a,r\n0,1,2\n# note\n1,1,2\n", {}, "row 2: .* set comment: '#'"),
        ("# note\nt,a,r\n0,1,2\n", {}, "the first line is '# note'; set comment: '#', or skip: 1"),
        ('t,a,r\n0,1,2\n1,1,"2\n2,1,3\n', {}, "a closing quote or a line break is missing after '1,1"),
        # Such as those of R, which writes no name of the column with the row numbers.
        ("t,a,r\n1,0.1,7,2.5\n2,0.2,7,2.6\n", {}, "columns: all names; skip: 1"),
        ("", {}, "the file is empty"),
        (HEADER + rows(factors={1: 40, 2: 40, 3: 40, 4: 100}), {}, "anchor 4 is .*set unit: mm or cm of range"),
        (BOOT, {"fields": MESSAGE}, "anchor = 'boot' does not match .*optional: true"),
        (every(100), {}, "100 s apart.*unit: ms"),
        (every(0.1), in_unit("ms"), "0.0001 s apart.*unit: s of the stamps"),
        (every(0.0001), {}, r"unit: s, scale: 3600 \(hours\)"),
        (every(100_000), {}, "unit: us"),
        (every(100_000), in_unit("ms"), "unit: us"),
        (every(1 / 864_000), {}, r"unit: s, scale: 86400 \(days\)"),
        ('t,a,r,i,q\n0,1,2,"3 4","-1 2 5"\n', {"cir": PARTS}, "row 1: 2 real and 3 imaginary parts"),
        (with_cir(round(40 + 30 / (1 + n), 2) for n in range(200)), AMPLITUDES, "row 1: a CIR in dB"),
        (with_cir((-1) ** n * 40 for n in range(200)), AMPLITUDES, "row 1: negative magnitudes .*interleaved, or complex.*cir.imaginary"),
    ],
)  # fmt: skip
def test_unsuitable_file_is_an_error_with_a_remedy(text: str, document: Any, message: str, tmp_path: Path):
    with pytest.raises(RecordingError, match=message):
        list(of(text, tmp_path / "x.csv", **document))


def test_decompression_bomb_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(text_blocks, "MIN_BOMB_CHARS", 1 << 18)
    with pytest.raises(RecordingError, match="expands to more than 500 times its size"):
        of(gzip.compress(b"t,a,r\n" + b"\n" * 2_000_000), tmp_path / "x.csv.gz")


def test_other_formats_are_refused_with_a_way(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    for name, valid in (("x.xlsx", "others as CSV"), ("x.log", "lines with `pattern` or `text`")):
        with pytest.raises(RecordingError, match=rf"unknown format .* {valid}"):
            of(b"PK", tmp_path / name)
    monkeypatch.setitem(sys.modules, "h5py", None)
    with pytest.raises(MissingDependencyError, match=r"h5py is not installed .*pip install h5py"):
        of(b"", tmp_path / "x.h5")


@pytest.mark.parametrize(("unit", "factor"), [("mm", 1000), ("cm", 100)])
@pytest.mark.parametrize("truth", [TRUE, {}], ids=["with truth", "without truth"])
def test_unit_of_one_anchor_is_found_and_can_be_set(unit: str, factor: float, truth: Any, tmp_path: Path):
    text = HEADER + rows(factors={3: factor})
    with pytest.raises(RecordingError, match=rf"anchor 3 is .*set units: {{3: {unit}}} of range"):
        of(text, tmp_path / "x.csv", **truth)
    fields = with_fields(range={"column": "r", "units": {3: unit}})
    assert of(text, tmp_path / "x.csv", **fields | TRUE).errors_m == pytest.approx(np.full(80, 0.1), abs=1e-4)


@pytest.mark.parametrize(
    "pairs",
    [
        [(true, true + 154.0) for true in (1.5, 3, 5, 8)],
        [(true, true * 1.02 + 11) for true in (2, 4, 6, 8)],
        [(0.04, 1.6), (6.0, 6.1), (8.0, 8.1), (9.0, 9.1)],
    ],
    ids=["offset of all anchors", "offset and scale", "one anchor next to the tag with a large error"],
)
def test_large_errors_are_no_unit(pairs: list[tuple[float, float]], tmp_path: Path):
    text = HEADER + "".join(f"{n},{n % 4},{pairs[n % 4][1]},{pairs[n % 4][0]}\n" for n in range(80))
    assert len(of(text, tmp_path / "x.csv", **TRUE)) == 80


def test_numbers_that_mean_no_measurement_are_dropped(tmp_path: Path):
    lines = (HEADER + rows()).splitlines(keepends=True)
    for n, number in ((5, "0"), (9, "0.00"), (17, "655.34998")):
        lines[n] = ",".join([*lines[n].split(",")[:2], number, lines[n].split(",")[3]])
    source = of("".join(lines), tmp_path / "x.csv", **TRUE)
    what = "which means no measurement"
    assert source.dropped == {f"range is 0, {what}": 2, f"range is 655.35, {what}": 1}
    assert source.errors_m == pytest.approx(np.full(77, 0.1), abs=1e-4)
    # A tag next to an anchor measures zero.
    near = "t,a,r\n" + "".join(f"{n},1,{abs(n - 20) / 100}\n" for n in range(80))
    assert not of(near, tmp_path / "y.csv").dropped
    zeros = "".join(f"{n + 0.5},2,0,{n % 2 * 4}\n" for n in range(80))
    mixed = HEADER + "".join(f"{line},0.1\n" for line in near.splitlines()[1:]) + zeros
    assert of(mixed, tmp_path / "z.csv", **TRUE).dropped == {f"range is 0, {what}": 40}


def test_true_ranges_of_another_file_are_interpolated(tmp_path: Path):
    true = "".join(f"{n / 5},{anchor},{anchor * 1000 + n}\n" for n in range(50) for anchor in (1, 2, 3))
    write(tmp_path / "true.csv", f"time,id,mm\n{true}")
    ranges = {"files": "true.csv", "stamp": "time", "anchor": "id", "range": {"column": "mm", "unit": "mm"}}
    text = "t,a,r\n0.1,1,1.2\n0.1,2,2.2\n0.1,4,4.2\n99,1,1.2\n"
    source = of(text, tmp_path / "x.csv", truth={"range": ranges})
    assert source.values["true range"] == pytest.approx([1.0005, 2.0005, np.nan, np.nan], nan_ok=True)
    assert source.notes == ["true ranges joined: 2 of 4"]
    del ranges["stamp"]
    with pytest.raises(RecordingError, match=r"have several true ranges \(truth.range.stamp"):
        read(PLAIN | {"truth": {"range": ranges}}, tmp_path / "x.csv")


def test_missing_file_of_anchors_is_named(tmp_path: Path):
    anchors = {"files": "site/anchors.csv", "id": "a", "position": ["x", 0, 0]}
    message = r"no file 'site/anchors.csv' \(relative to the folder of the ranges"
    with pytest.raises(RecordingError, match=message):
        of(HEADER + rows(), tmp_path / "x.csv", anchors=anchors)
    source = of(HEADER + rows(), tmp_path / "x.csv", anchors=anchors | {"optional": True})
    assert source.notes == [f"no anchors: no file 'site/anchors.csv' in {tmp_path}"]


def test_two_boots_are_two_parts(tmp_path: Path):
    text = HEADER + rows(40) + rows(40, start=0.05)
    source = of(text, tmp_path / "x.csv", **TRUE)
    what = "the clock starts again at row 41 of x.csv: 2 parts, with pauses of 5 s between them"
    assert source.warnings == [what]
    assert source.values["stamp"] / 1e9 == pytest.approx([*np.arange(40) / 10, *(8.9 + np.arange(40) / 10)])
    assert source.errors_m == pytest.approx(np.full(80, 0.1), abs=1e-4)
    write(tmp_path / "poses.csv", "t,x\n0,0\n9,0\n")
    poses = {"files": "poses.csv", "stamp": "t", "position": ["x", 0, 0]}
    with pytest.raises(RecordingError, match=r"the clock starts again .*one recording for each part"):
        read(PLAIN | {"truth": {"poses": poses}}, tmp_path / "x.csv")
    write(tmp_path / "two/run1.csv", HEADER + rows(40))
    write(tmp_path / "two/run2.csv", HEADER + rows(40, start=0.05))
    of_two = read(PLAIN | TRUE, tmp_path / "two")
    assert of_two.warnings == [what.replace("row 41 of x.csv", "row 1 of run2.csv")]
    assert of_two.values["stamp"].tolist() == source.values["stamp"].tolist()


@pytest.mark.parametrize("order", ["by anchor", "shuffled", "files"])
def test_unsorted_rows_of_one_clock_are_sorted(order: str, tmp_path: Path):
    lines = rows(80).splitlines(keepends=True)
    if order == "shuffled":
        lines = np.random.default_rng(1).permutation(lines).tolist()
    by_anchor = {anchor: [line for line in lines if f",{anchor}," in line] for anchor in range(1, 5)}
    if order == "by anchor":
        lines = [line for group in by_anchor.values() for line in group]
    for anchor, group in by_anchor.items():
        write(tmp_path / f"files/{anchor}.csv", HEADER + "".join(group))
    write(tmp_path / "one/x.csv", HEADER + "".join(lines))
    source = read(PLAIN, tmp_path / ("files" if order == "files" else "one"))
    assert not any("starts again" in warning for warning in source.warnings)
    assert source.values["stamp"] / 1e9 == pytest.approx(np.arange(80) / 10)


@pytest.mark.parametrize("lowest", [0, -(2**31)])
def test_stamps_of_a_32_bit_counter_are_continued(lowest: int, tmp_path: Path):
    counts = [2**32 - 2_000_000 + lowest + n * 100_000 for n in range(60)]
    stamps = [(count - lowest) % 2**32 + lowest for count in counts]
    text = "t,a,r\n" + "".join(f"{stamp},{n % 4},{n % 4 + 3}\n" for n, stamp in enumerate(stamps))
    source = of(text, tmp_path / "x.csv", **in_unit("us"))
    assert np.diff(source.values["stamp"]).tolist() == [100_000_000] * 59
    assert source.warnings == ["the stamps overflow or pass midnight; they were continued"]


@pytest.mark.parametrize(
    ("unit", "texts", "stamps_ns"),
    [
        ("s", ["1700000000.123456"], [1_700_000_000_123_456_000]),
        ("ms", ["1700000000123"], [1_700_000_000_123_000_000]),
        ("us", ["1700000000123456"], [1_700_000_000_123_456_000]),
        ("ns", ["1700000000123456789"], [1_700_000_000_123_456_789]),
        ("iso8601", ["2023-11-14T22:13:20.123456789Z"], [1_700_000_000_123_456_789]),
        ("iso8601", ["2023-11-15 00:13:20.5+02:00"], [1_700_000_000_500_000_000]),
        ("iso8601", ["23:59:59.5", "00:00:00.1"], [86_399_500_000_000, 86_400_100_000_000]),
        ("iso8601", ["2024-01-02 03:04:05,5"], [1_704_164_645_500_000_000]),
        ("%d/%m/%Y %H:%M:%S", ["02/01/2024 03:04:05"], [1_704_164_645_000_000_000]),
        ("%m/%d/%Y %H:%M:%S", ["01/02/2024 03:04:05"], [1_704_164_645_000_000_000]),
        ("%H.%M.%S", ["00.00.01", "00.00.02"], [1_000_000_000, 2_000_000_000]),
    ],
)
def test_stamps_of_every_unit(unit: str, texts: list[str], stamps_ns: list[int], tmp_path: Path):
    text = "t,a,r\n" + "".join(f'"{cell}",1,2.{n}\n' for n, cell in enumerate(texts))
    found = [one.measurement.stamp_ns for one in of(text, tmp_path / "x.csv", **in_unit(unit))]
    assert max(abs(one - other) for one, other in zip(found, stamps_ns, strict=True)) < 500


def test_repeated_rows_are_dropped_unless_the_clock_is_coarse(tmp_path: Path):
    text = rows(40)
    for repeated in (text + text, "".join(line * 2 for line in text.splitlines(keepends=True))):
        source = of(HEADER + repeated, tmp_path / "x.csv", **TRUE)
        assert (len(source), source.dropped, source.warnings) == (40, {"repeated row": 40}, [])
    coarse = "t,a,r\n" + "".join(f"{n // 10},1,{3 + n % 3 / 100}\n" for n in range(60))
    source = of(coarse, tmp_path / "x.csv")
    assert len(source) == 60
    assert source.warnings == ["54 ranges repeat the stamp of another range of the same pair"]


LOG = """boot v1.2
[12] Range: 2.31 m  from: 1D  RX power: -78.2 dBm
[112] Range: 2.35 m  from: 1E  RX power: -79 dBm
timeout
[212] Range: 2.33 m  from: 1D
"""
LINE = {
    "pattern": r"\[(?P<t>\d+)\] Range: (?P<r>[\d.]+) m +from: (?P<a>\w+)(?: +RX power: (?P<l>\S+))?",
    "fields": {
        "stamp": {"column": "t", "unit": "ms"}, "anchor": {"column": "a", "hex": True}, "range": "r", "rx_power": "l",
    },
}  # fmt: skip


@pytest.mark.parametrize("name", ["x.log", "x.txt"])
def test_lines_of_a_log_are_rows(name: str, tmp_path: Path):
    source = of(LOG, tmp_path / name, **LINE)
    assert values_of(source) == [(0.012, 1, 0x1D, 2.31), (0.112, 1, 0x1E, 2.35), (0.212, 1, 0x1D, 2.33)]
    assert source.values["rx_power"] == pytest.approx([-78.2, -79, np.nan], nan_ok=True)
    assert source.dropped == {"lines without a range, such as 'boot v1.2'": 2}
    with pytest.raises(RecordingError, match=r"no ranges .*lines without a range, such as 'hello'"):
        of("hello\nworld\n", tmp_path / name, **LINE)


def test_json_lines_and_documents_are_read(tmp_path: Path):
    rows = [{"t": 0, "a": 1, "r": 2.5}, {"t": 1, "a": 2, "r": 2.6}]
    lines = "ready\n" + "".join(f"{json.dumps(row)}\n" for row in rows)
    source = of(lines, tmp_path / "x.jsonl", text="json")
    assert values_of(source) == [(0.0, 1, 1, 2.5), (1.0, 1, 2, 2.6)]
    assert source.dropped == {"lines without a range, such as 'ready' (not JSON: 'ready')": 1}
    document = json.dumps({"runs": {"one": rows[:1], "two": rows[1:]}})
    assert values_of(of(document, tmp_path / "x.json", group="runs[][]")) == values_of(source)


def test_murp(tmp_path: Path):
    pairs = [f"{i}_{j}" for i in range(1, 7) for j in range(1, 7)]
    columns = [f"{pair}{kind}" for kind in ("", "_t", "_err") for pair in pairs]
    for base, target in ((1, 2), (2, 1)):
        lines = [",".join(["t", "x", *columns, "r", "r_t"])]
        for n in range(3):
            measured = [str(2 + base + n / 100) if pair in ("1_2", "6_3") else "" for pair in pairs]
            lines.append(",".join([str(n / 25), "0", *measured, *["1.9"] * 36, *["0.1"] * 36, "2", "2"]))
        for name, content in (("win-0_step-0", "\n".join(lines)), ("win-1_step-1", "filtered")):
            write(tmp_path / f"01/01_base-{base}_targ-{target}_{name}.csv", content)
    source = open_mapped(tmp_path / "01", "murp")
    expected = [(0.0, 11, 22, 3.0), (0.0, 16, 23, 3.0), (0.0, 21, 12, 4.0), (0.0, 26, 13, 4.0)]
    assert (len(source), values_of(source)[:4], set(source.values["true range"])) == (12, expected, {1.9})


def log_a_tec(position: tuple[float, float, float], anchor: int, channel: int) -> dict[str, Any]:
    place = (float(anchor), 2.0, 1.0)
    measured = round(float(np.linalg.norm(np.subtract(place, position))) + 0.1, 2)
    names = (
        "tag_id anchor_id x_tag y_tag z_tag x_anchor y_anchor z_anchor nlos range fp_index rss rss_fp fp_point1 fp_point2 "
        "fp_point3 stdev_noise cir_power max_noise rxpacc channel_number frame_length preamble_length bitrate prfr preamble_code"
    )
    nodes = "0B16", f"DECA{anchor}", *position, *place
    values = anchor % 2, measured, 745, -78.5, -80.1, *range(6), 1010, channel, 10, 1024, 110, 64, 9
    numbers = np.random.default_rng(anchor).integers(-200, 200, (1016, 2)).tolist()
    row = dict(zip(names.split(), [*nodes, *values], strict=True))
    return row | {"cir": [str(complex(*pair)) for pair in numbers]}


def test_log_a_tec(tmp_path: Path):
    positions = [(0.5, 1.0, 1.2), (1.5, 1.0, 1.2), (2.5, 1.0, 1.2)]
    document: dict[str, Any] = {"path": [], "measurements": {}}
    for position in positions:
        name = "_".join(f"{axis:.2f}" for axis in position)
        cells = {f"A{a}": {f"ch{c}": [log_a_tec(position, a, c)] * 2 for c in (1, 5)} for a in (1, 2)}
        document["measurements"][name] = cells
        for anchor, channel in ((1, 1), (2, 5)):
            row = log_a_tec(position, anchor, channel)
            line = ",".join([*(str(value) for name, value in row.items() if name != "cir"), *row["cir"]])
            content = f"v1.1\n{','.join(row).upper()}...\n{line}"
            write(tmp_path / f"raw/data/{name}/ch{channel}_A{anchor}.csv", content)
    write(tmp_path / "environment0/data.json", json.dumps(document))
    for path, mapping, count in (("environment0", "log_a_tec", 24), ("raw", "log_a_tec_raw", 6)):
        source = open_mapped(tmp_path / path, mapping)
        first = next(iter(source))
        assert (len(source), sorted(source.anchors.index)) == (count, [1, 2])
        assert source.notes == ["3 placements, with pauses of 5 s between them"]
        assert source.errors_m == pytest.approx(np.full(count, 0.1), abs=0.006)
        assert (first.tag_position, first.truth and first.truth.label) == (positions[0], "NLOS")
        assert (first.truth and first.truth.configuration) == "placement 1"
        cir, expected = first.measurement.cir, log_a_tec(positions[0], 1, 1)["cir"]
        assert [complex(*pair) for pair in cir.samples.reshape(-1, 2)] == [complex(text) for text in expected]
        diagnostics = cir.first_path_index, cir.preamble_count, cir.rx_power_dbm, cir.channel
        assert diagnostics == (745, 1010, -78.5, 1)


MARKERS = {6: 12, 9: 9, 10: 11, 11: 7, 12: 4, 13: 10, 15: 5, 16: 6}
"""Radio next to each marker of STAR-loc's sessions 1 and 2."""


def starloc(folder: Path, swapped: bool = False) -> Path:
    positions = {marker: np.array([3.0 * n, 5.0 - 2 * n, n / 2]) for n, marker in enumerate(MARKERS)}
    rows = "".join(f"{marker},{x},{y},{z}\n" for marker, (x, y, z) in positions.items())
    write(folder / "mocap/uwb_markers_v1.csv", f",x,y,z\n{rows}")
    lines = ["time_s,to_id,range,from_id,tag_pos_x,tag_pos_y,tag_pos_z,gt_range"]
    for n in range(400):
        marker, tag = list(MARKERS)[n % 8], np.array([n / 100, 1.0, 1.0])
        distance = np.linalg.norm(positions[marker] - tag)
        first, second = (1, MARKERS[marker]) if swapped else (MARKERS[marker], 1)
        lines.append(f"{n / 50},{first},{distance + 0.1},{second},{tag[0]},1,1,{distance}")
    write(folder / "data/loop-2d_s1/uwb.csv", "\n".join(lines))
    return folder / "data/loop-2d_s1"


def test_markers_get_the_ids_of_their_radios_and_wrong_ids_and_swapped_columns_are_reported(tmp_path: Path):
    source = open_mapped(starloc(tmp_path), "starloc")
    assert sorted(source.anchors.index) == sorted(MARKERS.values())
    assert not source.warnings
    document = load_mapping("starloc").model_dump()
    document["anchors"] = {**document["anchors"][0], "id": "Unnamed: 0"}
    differs, missing, unused = read(document, tmp_path / "data/loop-2d_s1").warnings
    assert differs.startswith("true ranges and distances from positions differ for anchor 6 by ")
    assert all(f" {radio} by " in differs for radio in (6, 10, 11, 12))
    assert " 9 by " not in differs
    assert missing == "3 of 8 anchors have no position: 4, 5, 7: compare the ids"
    assert unused == "3 anchors have a position but no range: 13, 15, 16"
    warnings = open_mapped(starloc(tmp_path / "swapped", swapped=True), "starloc").warnings
    assert warnings[0] == "1 of 1 anchors have no position: 1: are tag and anchor exchanged?"


def test_delay_of_cirs_and_the_offset_that_attaches_them_are_reported(tmp_path: Path):
    times = np.cumsum(np.random.default_rng(0).uniform(0.05, 0.3, 200))
    lines = [f'{t + 0.12:.4f},{n % 3},"[1, 2]"\n' for n, t in enumerate(times)]
    write(tmp_path / "cirs.csv", "t,a,c\n" + "".join(lines))
    text = "t,a,r\n" + "".join(f"{t:.4f},{n % 3},2\n" for n, t in enumerate(times))
    join = {"stamp": "t", "anchor": "a", "tolerance_s": 0.03}
    (warning,) = of(text, tmp_path / "x.csv", cir={"files": "cirs.csv", "column": "c", "join": join}).warnings
    assert "of 200; typical delay +0.12 s; cir.join.stamp with offset: -0.120 would attach more" in warning
    join["stamp"] = {"column": "t", "offset": -0.12}
    source = of(text, tmp_path / "x.csv", cir={"files": "cirs.csv", "column": "c", "join": join})
    assert not source.warnings
    assert [note.replace("-0.00", "+0.00") for note in source.notes] == [
        "CIRs attached: 200 of 200; typical delay +0.00 s"
    ]


@pytest.mark.parametrize(("unit", "metres"), [("ft", 0.3048), ("in", 0.0254)])
def test_feet_and_inches_are_found_by_the_truth(unit: str, metres: float, tmp_path: Path):
    rng = np.random.default_rng(1)
    true = rng.uniform(1, 6, 100)
    measured = (true + rng.exponential(0.2, 100) + 0.3) / metres
    text = "t,a,r,true\n" + "".join(f"{n / 10},1,{measured[n]:.3f},{true[n]:.3f}\n" for n in range(100))
    with pytest.raises(RecordingError, match=f"times the true ranges.*unit: {unit} of range"):
        of(text, tmp_path / "x.csv", truth={"range": "true"})
    fields = with_fields(range={"column": "r", "unit": unit})
    source = of(text, tmp_path / "x.csv", **fields | {"truth": {"range": "true"}})
    assert 0.3 < np.median(source.errors_m) < 0.6


@pytest.mark.parametrize(
    ("end", "warning"),
    [
        ("2,1,", "does not end with a line break"),
        ("2,1,1", "does not end"),
        ("2,1\n", "the last row is short"),
    ],
)
def test_cut_last_row_is_dropped_and_reported(end: str, warning: str, tmp_path: Path):
    source = of(f"t,a,r\n0,1,2\n1,1,3\n{end}", tmp_path / "x.csv")
    assert ranges_of(source) == [2.0, 3.0]
    (reported,) = source.warnings
    assert warning in reported


def test_placements_without_stamps_are_separated_by_pauses(tmp_path: Path):
    rows = "".join(f"{n % 4},{2 + n / 100},{n // 20 % 3},0,0,link{n % 4}\n" for n in range(120))
    truth: dict[str, Any] = {"tag_position": ["x", "y", "z"], "configuration": "where"}
    document = with_fields(stamp={"rate_hz": 10}) | {"moving": False, "truth": truth}
    source = of(f"a,r,x,y,z,where\n{rows}", tmp_path / "x.csv", **document)
    gaps = np.diff(source.values["stamp"] / 1e9)
    assert (gaps > 1).sum() == 2
    assert gaps.max() == pytest.approx(5.0)
    assert source.values["tag x"].tolist() == [0.0] * 40 + [1.0] * 40 + [2.0] * 40
    assert source.notes == ["3 placements, with pauses of 5 s between them"]
    del truth["tag_position"]
    assert read(document, tmp_path / "x.csv").notes == ["4 placements, with pauses of 5 s between them"]


def test_wide_tables_have_one_row_for_each_pair(tmp_path: Path):
    document = {
        "unpivot": {"range": r"r(\d+)", "level": r"s(\d+)"},
        "fields": {"stamp": "t", "anchor": "variable", "range": "range", "rx_power": "level"},
    }
    source = of("t,r1,s1,r12,s12\n0,2.5,-80,3.5,-81\n0.1,2.6,-82,,-83\n", tmp_path / "x.csv", **document)
    assert values_of(source) == [(0.0, 1, 1, 2.5), (0.0, 1, 12, 3.5), (0.1, 1, 1, 2.6)]
    assert [one.measurement.cir.rx_power_dbm for one in source] == [-80.0, -81.0, -82.0]
    assert source.dropped == {"range is not a number": 1}
    with pytest.raises(RecordingError, match=r"no column matches unpivot 'x\(.*t, r1, s1"):
        read(PLAIN | document | {"unpivot": {"range": r"x(\d)"}}, tmp_path / "x.csv")
    savemat(tmp_path / "x.mat", {"t": np.array([0.0, 0.1]), "dist": np.array([[2.5, 3.5], [2.6, np.nan]])})
    matrix = with_fields(anchor="variable", range="value") | {"unpivot": {"value": "dist"}}
    found = values_of(read(matrix, tmp_path / "x.mat"))
    assert found == [(0.0, 1, 1, 2.5), (0.0, 1, 2, 3.5), (0.1, 1, 1, 2.6)]


def test_models_get_the_radio_of_the_mapping_and_the_report_names_an_assumed_one(tmp_path: Path):
    text, assumed = with_cir(np.arange(1, 200)), "(assumed: set `radio`)"
    source = of(text, tmp_path / "x.csv", **AMPLITUDES)
    assert str(CirKind.of(next(iter(source)).measurement.cir)).startswith("DW1000 IPATOV (assumed) without")
    (text_of_model,) = models_of(source)
    assert assumed in text_of_model
    assert "universal_amplitude" in text_of_model
    for segment in ("IPATOV", "STS"):
        source = of(text, tmp_path / "x.csv", **AMPLITUDES, radio="DW3000", segment=segment)
        assert CirKind.of(next(iter(source)).measurement.cir).source == (RadioType.DW3000, Segment[segment])
        (model,) = models_of(source)
        assert assumed not in model
        assert ("no model in use fits" if segment == "IPATOV" else "dw3000_sts") in model
    line = {"name": "x", "text": "json", "fields": {"anchor": "a", "range": "r"}, "cir": PARTS}
    live = LiveConverter(Mapping.model_validate(line | {"radio": "DW3000", "segment": "STS"}), "lines")
    (measured,) = live.measurements('{"a": 1, "r": 2.0, "i": [1, 3], "q": [-2, 4]}', "port", 1)
    assert CirKind.of(measured.cir).source == (RadioType.DW3000, Segment.STS)
    assert measured.cir.samples.tolist() == [1, -2, 3, 4]
    with pytest.raises(ValidationError, match="segment: needs radio"):
        of(text, tmp_path / "x.csv", segment="STS")


def test_dry_run_shows_units_errors_outliers_names_and_what_is_missing(tmp_path: Path):
    fields = {"stamp": "t", "anchor": {"column": "a", "names": True}, "range": "r", "rx_power": "l"}
    truth = {"range": {"column": "true", "unit": "cm"}}
    write(tmp_path / "map.yaml", yaml.safe_dump(PLAIN | {"fields": fields, "truth": truth}))
    rows = "".join(
        f"{n / 10},{'hall' if n % 2 else 'lab'},{500 if n == 7 else 2},-80,190\n" for n in range(41)
    )
    write(tmp_path / "x.csv", f"t,a,r,l,true\n{rows}4.1,lab,1e297,-80,190\n")
    done = succeed("data import x.csv --map map.yaml --dry-run --json x.json", folder=tmp_path)
    for shown in (
        "4.0 s, 2 pairs with 20 to 21 ranges (5 to 5.2 Hz)",
        "Errors (measured - true) of 41 ranges",
        "41 of 41 ranges have no CIR",
        "Dropped 1 rows: range is above 10000",
        "no positions of the anchors",
        "no first-path level",
    ):
        assert shown in done.stdout
    assert "warning: 1 ranges are above 100 m" in done.stderr
    assert "warning: 1 errors are above 5 m" in done.stderr
    assert [line.split()[1:4:2] for line in done.stdout.splitlines() if "hall" in line] == [["hall", "2"]]
    assert "no receive level" not in done.stdout
    assert sorted(path.name for path in tmp_path.iterdir()) == ["map.yaml", "x.csv", "x.json"]
