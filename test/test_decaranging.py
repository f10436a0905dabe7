"""DecaRanging logs: the format, malformed parts, damage, surveys, and the real recordings."""

import lzma
import math
import re
from collections import Counter
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pytest

from uwb_mitigation.errors import DamagedRecordingError, RecordingError
from uwb_mitigation.recordings.decaranging import Anomaly, CirFrame, DecaRangingLog, open_decaranging
from uwb_mitigation.types.measurement import DEVICE_TICK_HZ, DEVICE_TIME_WRAP, Record, Truth

ANCHOR, TAG = 0x100632205E37FA35, 0x100637205E37FAC2
START_NS = 1_515_417_223 * 10**9  # 2018-01-08 13:13:43 UTC
SECOND = int(DEVICE_TICK_HZ)


def header(file: str = "File:20180108-131343_All.log, created by DecaRanging MP Version 3.05") -> str:
    return f"{file}\nMode: 2, Chan 2, Code 9, PRF 64, Plength 1024, DataRate 1, PAC 2, ic:1000fa35\n\n"


def dump(samples: Iterable[tuple[object, object]], length: object = None) -> str:
    samples = list(samples)
    lines = "".join(f"{re}, {im}\n" for re, im in samples)
    return f"Accum Len {len(samples) if length is None else length}\n{lines}\n"


def ramp(start: int, length: int = 6) -> list[tuple[int, int]]:
    return [(start + i, -start - i) for i in range(length)]


def received(
    code: int, ticks: int, accumulator: str, *, hlp: str = "0002.5000", rsl: str = "-079.9641"
) -> str:
    address = ANCHOR.to_bytes(8, "little").hex() + TAG.to_bytes(8, "little").hex()
    stamp = f"{ticks % DEVICE_TIME_WRAP:010X}"
    return (
        f"{code:02X} 41 Rx time = 5.57e-003 {stamp}\n\n{code:02X} 41 Rx time(un) = 5.57e-003 {stamp}\n\n"
        f"txdly 4045 rxdly 4045\nRX DATA: 41cc41cade{address}{code:02x}b752\n\n"
        f"RX OK WInd(0735), HLP({hlp}), PSC(0998), SLP(0000.0000), RC(00{stamp[:2]} {stamp[2:]}), DCR(0), "
        f"DCI(0), NTH(03CB), T(80BE), RSL({rsl}), FSL(-081.5000), RSMPL(04)\n{accumulator}"
    )


def poll(ticks: int, samples: list[tuple[int, int]] | None = None) -> str:
    return received(0x21, ticks, dump(ramp(100) if samples is None else samples))


def final(ticks: int, samples: list[tuple[int, int]] | None = None, **fields: str) -> str:
    return received(0x29, ticks, dump(ramp(200) if samples is None else samples), **fields)


TRANSMIT = "TX Frame TimeStamp Raw  = 1F D75A1045\n   Adding Antenna Delay = 001F D75A1045\n01 Tx time = 2.14e+000\n\n"


def ranged(metres: object) -> str:
    return (
        f"Anchor ToF: 18.835 ns Dist: {metres} m DistRaw: 5.6 m DistScal: 5.6 m Bias: -0.040 m "
        "ClockOffset: -0.430 ppm\n\nRa  000000023b4a37a8 Db 000000023b4a3e6c\n\n"
        "Rb1  50000156.844702 Da1 50000033.428486  ns\n\n"
    )


def exchange(metres: float, at_s: float = 0.0) -> str:
    ticks = int(at_s * SECOND)
    return poll(ticks) + TRANSMIT + final(ticks + SECOND // 4) + ranged(metres)


def error_block(code: str) -> str:
    return (
        f"RX E{code} WInd(0735), PSC(0295), CE(0000), RSE(0000), HE(0000), STO(0001), FFE(0000), T(81BE), "
        f"RSL(-079.3863), FSL(-089.2351), RSMPL(3D)\n{dump(ramp(900))}"
    )


@pytest.fixture
def write(tmp_path: Path):
    """Write a log with the line ends of the format; return its path."""

    def _write(*parts: str, name: str = "7.log") -> Path:
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        data = "".join(parts).replace("\n", "\r\n").encode("latin-1")
        path.write_bytes(lzma.compress(data, preset=0) if name.endswith(".xz") else data)
        return path

    return _write


def read(path: Path, cir: CirFrame = CirFrame.FINAL) -> tuple[list[Record], Counter[str]]:
    """Return records and `skipped`, without the count of logs without truth."""
    log = DecaRangingLog(path, cir)
    records = list(log)
    return records, log.skipped - Counter({Anomaly.NO_TRUTH.value: 1})


def counts(*anomalies: Anomaly) -> dict[str, int]:
    return dict(Counter(anomaly.value for anomaly in anomalies))


def contents(records: Iterable[Record]) -> list[tuple[float, list[int]]]:
    return [(record.measurement.range_m, record.measurement.cir.samples.tolist()) for record in records]


@pytest.mark.parametrize("name", ["7.log", "7.log.xz"])
def test_exchange_becomes_a_measurement_with_the_cir_of_final(write, name):
    records, skipped = read(write(header(), exchange(5.644976), name=name))
    (measurement,) = [record.measurement for record in records]
    cir = measurement.cir
    assert measurement.range_m == 5.644976
    assert (measurement.tag_id, measurement.anchor_id) == (TAG, ANCHOR)
    assert measurement.device_time == SECOND // 4
    assert measurement.stamp_ns == START_NS + 250_000_000
    assert cir.samples.dtype == np.int16
    assert cir.samples.tolist() == [200, -200, 201, -201, 202, -202, 203, -203, 204, -204, 205, -205]
    assert (cir.start_index, cir.first_path_index, cir.scale) == (0, 2.5, 1.0)
    assert (cir.preamble_count, cir.noise_threshold) == (998, 0x3CB)
    assert (cir.rx_power_dbm, cir.first_path_power_dbm) == (-79.9641, -81.5)
    assert (cir.channel, cir.prf_mhz) == (2, 64)
    assert skipped == {}


def test_stamps_continue_when_the_radios_counter_wraps(write):
    records, _ = read(write(header(), *(exchange(5.0, at_s=15.0 + i) for i in range(5))))
    assert [record.measurement.stamp_ns - START_NS for record in records] == [
        pytest.approx(i * 1e9 + 250_000_000, abs=2) for i in range(5)
    ]
    assert all(record.measurement.device_time < DEVICE_TIME_WRAP for record in records)
    assert [record.measurement.sequence for record in records] == [0, 1, 2, 3, 4]


@pytest.mark.parametrize(
    "file", ["File:29991399-999999_x DecaRanging", "File:x, DecaRanging", "File:99990101-000000_DecaRanging"]
)
def test_invalid_start_time_becomes_the_epoch(write, file):
    records, skipped = read(write(header(file), exchange(5.0)))
    assert records[0].measurement.stamp_ns == 250_000_000
    assert skipped == counts(Anomaly.NO_START_TIME)


@pytest.mark.parametrize(
    ("text", "samples", "anomalies"),
    [
        (poll(0) + TRANSMIT + error_block("\0") + final(SECOND) + ranged(5.0), 6, [Anomaly.RECEPTION_ERROR]),
        (ranged(5.0), 0, [Anomaly.NO_CIR]),
        (poll(0) + ranged(5.0), 0, [Anomaly.NO_CIR]),
        (poll(0) + poll(SECOND) + TRANSMIT + final(2 * SECOND) + ranged(5.0), 6, [Anomaly.NO_RANGE]),
        (poll(0) + final(1) + final(SECOND) + ranged(5.0), 6, [Anomaly.NO_RANGE]),
        (poll(0) + final(1) + poll(SECOND) + ranged(5.0), 0, [Anomaly.NO_RANGE, Anomaly.NO_CIR]),
        (poll(0) + final(SECOND) + TRANSMIT + ranged(5.0), 6, []),
        (poll(0) + received(0x2A, 1, dump(ramp(5))) + final(2) + ranged(5.0), 6, []),
        (poll(0) + final(1, rsl="-001.#INF") + ranged(5.0), 6, [Anomaly.NOT_A_NUMBER]),
        (poll(0) + final(1, hlp="") + ranged(5.0), 6, [Anomaly.NOT_A_NUMBER]),
        *(
            (poll(0) + final(1).replace(good, bad) + ranged(5.0), 0, None)
            for good, bad in (("03CB", "zz"), ("0998", "99999"), ("41cc", "zz"), ("41cc", "4" * 300_000))
        ),
        ("\x00\x01\xff garbage\n" + exchange(5.0), 6, []),
    ],
)
def test_malformed_exchange_keeps_its_range(write, text, samples, anomalies):
    records, skipped = read(write(header(), text, exchange(6.0, 3.0)))
    assert [record.measurement.range_m for record in records] == [5.0, 6.0]
    assert [len(record.measurement.cir) for record in records] == [samples, 6]
    if anomalies is None:
        assert skipped[Anomaly.MALFORMED.value] >= 1
        assert skipped[Anomaly.NO_CIR.value] == 1
    else:
        assert skipped == counts(*anomalies)


@pytest.mark.parametrize("text", ["-1.#IND", "1.#QNAN", "nan", "inf", "1e999", "1e300", "five", "1_0"])
def test_range_that_is_not_a_number_is_nan(write, text):
    records, skipped = read(write(header(), poll(0) + final(1) + ranged(text)))
    assert math.isnan(records[0].measurement.range_m)
    assert len(records[0].measurement.cir) == 6
    assert skipped == counts(Anomaly.NOT_A_NUMBER)


@pytest.mark.parametrize(
    "bad",
    [
        *(dump([(1, 2), (sample, 4), (5, 6)]) for sample in (3.5, 32768, "9" * 400)),
        dump([(1, 2), ("3", ""), (5, 6)]),
        dump([(1, 2), (3, 4)], length=3),
        *(dump(ramp(0), length) for length in (4, 999_999_999, -1)),
        dump(ramp(0, 1017)),
    ],
)
def test_malformed_accumulator_loses_only_the_cir(write, bad):
    text = poll(0) + received(0x29, 1, bad) + ranged(5.0) + exchange(6.0, 1.0)
    records, skipped = read(write(header(), text))
    assert [record.measurement.range_m for record in records] == [5.0, 6.0]
    assert [len(record.measurement.cir) for record in records] == [0, 6]
    assert records[0].measurement.cir.rx_power_dbm == -79.9641
    assert skipped == counts(Anomaly.MALFORMED, Anomaly.NO_CIR)


def test_log_cut_at_any_byte_yields_the_exchanges_before_the_cut(write):
    path = write(header(), exchange(1.0), exchange(2.0, 1.0), exchange(3.0, 2.0))
    data = path.read_bytes()
    line_ends = [match.end() for match in re.finditer(rb"Anchor ToF.*\r\n", data)]
    complete = contents(read(path)[0])
    for size in range(0, len(data), 7):
        path.write_bytes(data[:size])
        records, error = [], None
        try:
            records.extend(DecaRangingLog(path))
        except RecordingError as caught:
            error = caught
        assert contents(records) == complete[: sum(end <= size for end in line_ends)]
        if size > 200 and data[size - 1 : size] != b"\n":
            assert isinstance(error, DamagedRecordingError)


@pytest.mark.parametrize(
    ("name", "data"),
    [
        ("a.log", b""),
        ("a.log.xz", b""),
        ("a.log.xz", lzma.compress(b"")),
        ("a.log", b"time,range\r\n0.1,5.0\r\n"),
        ("a.log", bytes(range(256)) * 999 + b"\n"),
        ("a.log.xz", b"File: of something else"),
        ("a.log", None),
    ],
)
def test_other_file_is_refused_and_named(tmp_path, name, data):
    path = tmp_path / name
    if data is not None:
        path.write_bytes(data)
    with pytest.raises(RecordingError) as caught:
        list(open_decaranging(path))
    assert str(path) in caught.value.where


@pytest.fixture
def surveyed(write, tmp_path) -> Path:
    folder = tmp_path / "flat"
    for number, metres in ((3, 1.0), (4, 2.0)):
        write(header(), exchange(metres), exchange(metres + 0.5, 1.0), name=f"flat/logs/{number}.log.xz")
    (folder / "pairs.csv").write_text("file_number,anchor_location,tag_location\n3,2,1\n4,1,1\n")
    (folder / "anchors.csv").write_text("location,x,y\n1,0,0\n2,3,4\n")
    (folder / "tags.csv").write_text("location,x,y\n1,0,0\n")
    (folder / "labels.csv").write_text("file_id,label\n3,NDP NLOS\n")
    return folder


@pytest.mark.parametrize("inside", ["", "logs"])
def test_folder_gives_truth_and_locations_in_order_of_time(surveyed, inside):
    folder = open_decaranging(surveyed / inside)
    records = list(folder)
    assert [record.truth for record in records[::2]] == [
        Truth(5.0, "NDP NLOS", "flat/3"),
        Truth(0.0, "", "flat/4"),
    ]
    assert [(r.measurement.tag_id, r.measurement.anchor_id) for r in records[::2]] == [(1, 2), (1, 1)]
    stamps = [record.measurement.stamp_ns for record in records]
    assert stamps == sorted(stamps)
    assert [record.measurement.sequence for record in records] == [0, 1, 2, 3]
    assert folder.skipped == counts(Anomaly.MOVED)  # both have the same start time
    assert [(anchor.id, anchor.position) for anchor in folder.anchors.anchors] == [
        (1, (0.0, 0.0, 0.0)),
        (2, (3.0, 4.0, 0.0)),
    ]
    assert next(iter(open_decaranging(surveyed / "logs" / "3.log.xz"))).truth == records[0].truth


def test_log_without_a_survey_row_keeps_its_addresses(surveyed, write):
    write(header(), exchange(9.0), name="flat/logs/5.log")
    write(header(), exchange(7.0), name="flat/logs/3.log")
    folder = open_decaranging(surveyed)
    records = list(folder)
    # If a log exists twice, only the uncompressed one is read.
    assert [record.measurement.range_m for record in records] == [7.0, 2.0, 2.5, 9.0]
    assert records[-1].truth is None
    assert (records[-1].measurement.tag_id, records[-1].measurement.anchor_id) == (TAG, ANCHOR)
    assert folder.skipped[Anomaly.NO_TRUTH.value] == 1


def test_damaged_log_does_not_stop_the_other_logs(surveyed):
    path = surveyed / "logs" / "3.log.xz"
    path.write_bytes(path.read_bytes()[:-30])
    folder = open_decaranging(surveyed)
    ranges = []
    with pytest.raises(RecordingError) as caught:
        ranges.extend(record.measurement.range_m for record in folder)
    assert str(path) in caught.value.where
    assert ranges[-2:] == [2.0, 2.5]
    assert folder.skipped[Anomaly.UNREADABLE.value] == 1


@pytest.mark.parametrize(
    ("name", "text", "line"),
    [
        ("pairs.csv", "file_number,anchor\n3,2\n", None),
        ("pairs.csv", "file_number,anchor_location,tag_location\n3,2\n", 2),
        ("pairs.csv", "file_number,anchor_location,tag_location\n3,9,1\n", 2),
        ("pairs.csv", "file_number,anchor_location,tag_location\nx,2,1\n", 2),
        ("pairs.csv", "file_number,anchor_location,tag_location\n3,2,1\n3,1,1\n", 3),
        ("anchors.csv", "location,x,y\n1,0,nan\n2,0,0\n", 2),
        ("tags.csv", None, None),
        ("labels.csv", "\xff\0" * 99, None),
        ("tags.csv", "location,x,y\n" * 100_000, None),
    ],
)
def test_malformed_survey_is_rejected_with_file_and_row(surveyed, name, text, line):
    if text is None:
        (surveyed / name).unlink()
    else:
        (surveyed / name).write_bytes(text.encode("latin-1"))
    with pytest.raises(RecordingError) as caught:
        open_decaranging(surveyed)
    assert name in caught.value.where
    assert line is None or caught.value.where.endswith(f"row {line - 1}")
