"""DecaRanging logs: the format, each of its oddities, damage, and the real recordings."""

from __future__ import annotations

import lzma
import math
import re
import tracemalloc
from collections import Counter
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from uwb_mitigation.errors import DamagedRecordingError, RecordingError
from uwb_mitigation.measurement import DEVICE_TICK_HZ, DEVICE_TIME_WRAP, Record, Truth
from uwb_mitigation.sources.decaranging import (
    CirOf,
    DecaRangingFolder,
    DecaRangingLog,
    Oddity,
    open_decaranging,
)
from uwb_mitigation.sources.log_lines import XZ_MAGIC, parse_pairs

ANCHOR, TAG = 0x100632205E37FA35, 0x100637205E37FAC2
START_NS = 1_515_417_223 * 10**9  # 2018-01-08 13:13:43 UTC
SECOND = int(DEVICE_TICK_HZ)


# ---- a small writer of the format ----


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
    """Writes a log with the format's line ends, and gives its path."""

    def _write(*parts: str, name: str = "7.log") -> Path:
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        data = "".join(parts).replace("\n", "\r\n").encode("latin-1")
        path.write_bytes(lzma.compress(data, preset=0) if name.endswith(".xz") else data)
        return path

    return _write


def read(path: Path, **options) -> tuple[list[Record], Counter[str]]:
    with DecaRangingLog(path, truth=Truth(1.0), **options) as log:
        records = list(log)
    return records, log.skipped


def read_until_damage(path: Path) -> tuple[list[Record], RecordingError | None]:
    records: list[Record] = []
    try:
        for record in DecaRangingLog(path):
            records.append(record)  # noqa: PERF402 - what came before the error is wanted
    except RecordingError as error:
        return records, error
    return records, None


# ---- what an exchange becomes ----


def test_an_exchange_becomes_a_measurement_with_the_finals_cir(write):
    records, skipped = read(write(header(), exchange(5.644976)))
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


def test_the_polls_cir_on_request(write):
    records, _ = read(write(header(), exchange(5.0)), cir=CirOf.POLL)
    measurement = records[0].measurement
    assert measurement.cir.samples[0] == 100
    assert measurement.device_time == 0
    assert measurement.stamp_ns == START_NS + 250_000_000


def test_ids_can_be_given(write):
    records, _ = read(write(header(), exchange(5.0)), tag_id=3, anchor_id=0)
    assert (records[0].measurement.tag_id, records[0].measurement.anchor_id) == (3, 0)


def test_stamps_go_on_where_the_radios_counter_wraps(write):
    path = write(header(), *(exchange(5.0, at_s=15.0 + i) for i in range(5)))
    records, _ = read(path)
    assert [record.measurement.stamp_ns - START_NS for record in records] == [
        pytest.approx(i * 1e9 + 250_000_000, abs=2) for i in range(5)
    ]
    assert all(record.measurement.device_time < DEVICE_TIME_WRAP for record in records)
    assert [record.measurement.sequence for record in records] == [0, 1, 2, 3, 4]


def test_the_receive_counter_is_taken_to_40_bits(write):
    text = exchange(5.0).replace("RC(00", "RC(FF")
    records, _ = read(write(header(), text))
    assert records[0].measurement.device_time == SECOND // 4


def test_line_feeds_alone_are_read_too(tmp_path):
    path = tmp_path / "7.log"
    path.write_text(header() + exchange(5.0), newline="\n")
    records, skipped = read(path)
    assert len(records[0].measurement.cir) == 6
    assert skipped == {}


def test_a_log_can_be_read_again_and_yields_the_same(write):
    log = DecaRangingLog(write(header(), exchange(5.0), error_block("\0")))
    first, second = list(log), list(log)
    assert len(first) == len(second) == 1
    assert first[0].measurement.stamp_ns == second[0].measurement.stamp_ns
    assert log.skipped[Oddity.RECEPTION_ERROR.value] == 1


def test_the_name_says_kind_and_file(write):
    log = DecaRangingLog(write(header(), name="19.log.xz"))
    assert log.name == "DecaRanging log 19.log.xz"
    assert not log.simulated


# ---- oddities: each is counted, and none costs a range ----


def only(skipped: Counter[str], oddity: Oddity, count: int = 1) -> bool:
    return dict(skipped) == {oddity.value: count}


@pytest.mark.parametrize(
    ("code", "oddity"), [("\0", Oddity.RECEPTION_ERROR), ("C", Oddity.RECEPTION_ERROR_CODED)]
)
def test_a_reception_in_error_leaves_its_exchange_alone(write, code, oddity):
    text = poll(0) + TRANSMIT + error_block(code) + final(SECOND) + ranged(5.0)
    records, skipped = read(write(header(), text))
    assert records[0].measurement.cir.samples[0] == 200
    assert only(skipped, oddity)


def test_a_reception_in_error_ends_a_frame_that_was_begun(write):
    begun, _, rest = final(1).partition("RX OK")
    text = poll(0) + begun + error_block("\0") + "RX OK" + rest + ranged(5.0)
    records, skipped = read(write(header(), text))
    assert len(records[0].measurement.cir) == 0
    assert skipped[Oddity.BAD_FRAME.value] == 2


def test_a_power_of_minus_infinity_is_unknown(write):
    text = poll(0) + final(SECOND, rsl="-001.#INF") + ranged(5.0)
    records, skipped = read(write(header(), text))
    assert math.isnan(records[0].measurement.cir.rx_power_dbm)
    assert records[0].measurement.cir.first_path_power_dbm == -81.5
    assert only(skipped, Oddity.POWER_NOT_A_NUMBER)


def test_a_range_before_any_frame_is_kept_without_a_cir(write):
    records, skipped = read(write(header(), ranged(4.0), exchange(5.0)))
    first, second = (record.measurement for record in records)
    assert (first.range_m, second.range_m) == (4.0, 5.0)
    assert (first.stamp_ns, first.device_time, len(first.cir)) == (START_NS, 0, 0)
    assert only(skipped, Oddity.RANGE_BEFORE_FRAMES)


def test_a_retried_poll_takes_the_place_of_the_first(write):
    text = poll(0, ramp(1)) + TRANSMIT + poll(SECOND, ramp(2)) + TRANSMIT + final(2 * SECOND) + ranged(5.0)
    records, skipped = read(write(header(), text), cir=CirOf.POLL)
    assert records[0].measurement.cir.samples[0] == 2
    assert only(skipped, Oddity.RETRIED_POLL)


def test_a_transmit_line_after_the_final_changes_nothing(write):
    records, skipped = read(write(header(), poll(0) + final(SECOND) + TRANSMIT + ranged(5.0)))
    assert records[0].measurement.cir.samples[0] == 200
    assert only(skipped, Oddity.TRANSMIT_AFTER_FINAL)


@pytest.mark.parametrize("rest", [poll(0), poll(0) + TRANSMIT, poll(0) + final(SECOND)])
def test_a_log_may_end_in_the_middle_of_an_exchange(write, rest):
    records, skipped = read(write(header(), exchange(5.0), rest))
    assert len(records) == 1
    assert only(skipped, Oddity.UNFINISHED)


def test_an_exchange_that_gave_no_range_is_counted(write):
    records, skipped = read(write(header(), poll(0), final(1), exchange(5.0, 1.0)))
    assert len(records) == 1
    assert only(skipped, Oddity.NO_RANGE)


def test_a_range_without_a_final_is_kept_without_a_cir(write):
    records, skipped = read(write(header(), exchange(4.0), poll(2 * SECOND), ranged(5.0)))
    measurement = records[1].measurement
    assert (measurement.range_m, len(measurement.cir)) == (5.0, 0)
    assert measurement.stamp_ns == START_NS + 2 * 10**9
    assert measurement.device_time == 2 * SECOND
    assert only(skipped, Oddity.RANGE_WITHOUT_CIR)


@pytest.mark.parametrize("text", ["-1.#IND", "1.#QNAN", "nan", "inf", "1e999", "1e300", "five", "1_0"])
def test_a_range_that_is_not_a_number_is_nan(write, text):
    records, skipped = read(write(header(), poll(0) + final(1) + ranged(text)))
    assert math.isnan(records[0].measurement.range_m)
    assert len(records[0].measurement.cir) == 6
    assert only(skipped, Oddity.RANGE_NOT_A_NUMBER)


def test_exponents_of_three_digits_are_read(write):
    text = poll(0) + final(1, hlp="2.5e+000", rsl="-7.99e+001") + ranged("5.57e-003")
    records, skipped = read(write(header(), text))
    measurement = records[0].measurement
    assert (measurement.range_m, measurement.cir.first_path_index) == (0.00557, 2.5)
    assert measurement.cir.rx_power_dbm == -79.9
    assert skipped == {}


def test_a_late_first_path_is_no_oddity(write):
    records, skipped = read(write(header(), poll(0) + final(1, ramp(0, 1016), hlp="0838.1250") + ranged(5.0)))
    assert records[0].measurement.cir.first_path_index == 838.125
    assert skipped == {}


def test_a_first_path_outside_the_accumulator_is_kept_and_counted(write):
    records, skipped = read(write(header(), poll(0) + final(1, hlp="0006.0000") + ranged(5.0)))
    assert records[0].measurement.cir.first_path_index == 6.0
    assert only(skipped, Oddity.FIRST_PATH_OUTSIDE)


@pytest.mark.parametrize("text", ["-001.#INF", "-3.0", "1024.0", "1e300", ""])
def test_a_first_path_that_the_radio_cannot_report_is_unknown(write, text):
    records, skipped = read(write(header(), poll(0) + final(1, hlp=text) + ranged(5.0)))
    assert math.isnan(records[0].measurement.cir.first_path_index)
    assert only(skipped, Oddity.FIRST_PATH_NOT_A_NUMBER)


@pytest.mark.parametrize(
    "bad",
    [
        dump([(1, 2), (3.5, 4), (5, 6)]),
        dump([(1, 2), ("x", 4), (5, 6)]),
        dump([(1, 2), (32768, 4), (5, 6)]),
        dump([(1, 2), (-32769, 4), (5, 6)]),
        dump([(1, 2), ("--3", 4), (5, 6)]),
        dump([(1, 2), ("3", ""), (5, 6)]),
        dump([(1, 2), ("9" * 400, 4), (5, 6)]),
        dump([(1, 2), ("9" * 100_000, 4), (5, 6)]),
        dump([(1, 2), (3, 4)], length=3),
        dump(ramp(0, 1017)),
        dump([(1, 2), (3, 4)], length=3).rstrip("\n") + "\n",
        dump(ramp(0), length=999_999_999),
        dump(ramp(0), length="9" * 40),
        dump(ramp(0), length=0),
        dump(ramp(0), length=-1),
        dump(ramp(0), length="many"),
    ],
)
def test_a_malformed_accumulator_costs_the_cir_and_nothing_else(write, bad):
    text = poll(0) + received(0x29, 1, bad) + ranged(5.0) + exchange(6.0, 1.0)
    records, skipped = read(write(header(), text))
    assert [record.measurement.range_m for record in records] == [5.0, 6.0]
    assert [len(record.measurement.cir) for record in records] == [0, 6]
    assert records[0].measurement.cir.rx_power_dbm == -79.9641
    assert dict(skipped) == {Oddity.BAD_ACCUMULATOR.value: 1, Oddity.RANGE_WITHOUT_CIR.value: 1}


def test_more_lines_than_the_accumulator_announces_are_counted(write):
    text = poll(0) + received(0x29, 1, dump(ramp(200), length=4)) + ranged(5.0)
    records, skipped = read(write(header(), text))
    assert len(records[0].measurement.cir) == 4
    assert only(skipped, Oddity.UNKNOWN_LINE, 2)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("NTH(03CB)", "NTH(zz)"),
        ("PSC(0998)", "PSC(99999)"),
        ("RX DATA: 41cc", "RX DATA: 4"),
        ("RX DATA: 41cc", "RX DATA: zz"),
    ],
)
def test_a_malformed_frame_costs_its_cir_and_nothing_else(write, old, new):
    text = poll(0) + final(1).replace(old, new) + ranged(5.0)
    records, skipped = read(write(header(), text))
    assert (records[0].measurement.range_m, len(records[0].measurement.cir)) == (5.0, 0)
    assert skipped[Oddity.BAD_FRAME.value] >= 1
    assert skipped[Oddity.RANGE_WITHOUT_CIR.value] == 1


def test_a_frame_of_another_kind_is_counted(write):
    records, skipped = read(write(header(), poll(0), received(0x2A, 1, dump(ramp(5))), final(2), ranged(5.0)))
    assert records[0].measurement.cir.samples[0] == 200
    assert only(skipped, Oddity.OTHER_FRAME)


def test_garbage_between_exchanges_is_counted(write):
    garbage = bytes(range(256)).decode("latin-1").replace("\r", "").replace("\n", "")
    records, skipped = read(write(header(), exchange(4.0), f"{garbage}\n", exchange(5.0, 1.0)))
    assert len(records) == 2
    assert only(skipped, Oddity.UNKNOWN_LINE)


@pytest.mark.parametrize("length", [5_000, 200_000, 3_000_000])
def test_an_endless_line_is_passed_over(write, length):
    records, skipped = read(
        write(header(), exchange(4.0), "RX DATA: " + "4" * length + "\n", exchange(5.0, 1.0))
    )
    assert len(records) == 2
    assert only(skipped, Oddity.UNKNOWN_LINE)


@pytest.mark.parametrize(
    "file", ["File:29991399-999999_x DecaRanging", "File:x, DecaRanging", "File:99990101-000000_DecaRanging"]
)
def test_a_nonsensical_start_time_becomes_the_epoch(write, file):
    records, skipped = read(write(header(file), exchange(5.0)))
    assert records[0].measurement.stamp_ns == 250_000_000
    assert only(skipped, Oddity.NO_START_TIME)


def test_a_log_without_its_header_is_read(write):
    records, skipped = read(write(exchange(5.0).partition("txdly")[2].partition("\n")[2]))
    assert (records[0].measurement.cir.channel, records[0].measurement.cir.prf_mhz) == (0, 0)
    assert dict(skipped) == {Oddity.NO_START_TIME.value: 1, Oddity.BAD_HEADER.value: 1}


def test_a_log_without_truth_is_counted(write):
    log = DecaRangingLog(write(header(), exchange(5.0)))
    assert [record.truth for record in log] == [None]
    assert only(log.skipped, Oddity.NO_TRUTH)


# ---- numbers in bulk ----

int16 = st.integers(-32768, 32767)


@settings(max_examples=60)
@given(st.lists(st.tuples(int16, int16), min_size=1, max_size=40), st.sampled_from(["\n", "\r\n"]))
def test_bulk_parsing_equals_int(pairs, end):
    text = "".join(f"{re}, {im}{end}" for re, im in pairs).encode()
    parsed = parse_pairs(np.frombuffer(text + b"\r\nTX Frame", np.uint8), len(pairs))
    assert parsed is not None
    assert parsed[0].tolist() == [value for pair in pairs for value in pair]
    assert parsed[1] == len(text)


@settings(max_examples=300)
@given(
    st.lists(
        st.sampled_from([b"1", b"-", b",", b" ", b"\n", b"\r", b", ", b"\r\n", b"x", b"99999"]), max_size=24
    )
)
def test_bulk_parsing_accepts_just_what_the_grammar_does(tokens):
    text = b"".join(tokens)
    parsed = parse_pairs(np.frombuffer(text, np.uint8), 2)
    number = rb"(-?\d{1,5})"
    strict = [re.match(2 * (number + b", " + number + end), text) for end in (rb"\n", rb"\r\n")]
    match = strict[0] or strict[1]
    if match is None or any(abs(int(value)) > 32767 for value in match.groups()):
        assert parsed is None
    else:
        assert parsed is not None
        assert parsed[0].tolist() == [int(value) for value in match.groups()]


@pytest.mark.parametrize(
    "text", [b"1,x2\r\n3, 4\r\n", b"1, 2x\n3, 4\r\n", b"1, 2\n3, 4\r\n", b"1, 2\r\n3, 4"]
)
def test_bulk_parsing_accounts_for_every_byte(text):
    assert parse_pairs(np.frombuffer(text, np.uint8), 2) is None


# ---- damage ----


def test_a_log_cut_at_any_byte_yields_the_exchanges_before_the_cut(write):
    path = write(header(), exchange(1.0), exchange(2.0, 1.0), exchange(3.0, 2.0))
    data = path.read_bytes()
    line_ends = [match.end() for match in re.finditer(rb"Anchor ToF.*\r\n", data)]
    whole, _ = read(path)
    for size in range(0, len(data), 3):
        path.write_bytes(data[:size])
        records, error = read_until_damage(path)
        assert [record.measurement.range_m for record in records] == [
            whole[i].measurement.range_m for i, end in enumerate(line_ends) if end <= size
        ]
        for got, expected in zip(records, whole, strict=False):
            assert np.array_equal(got.measurement.cir.samples, expected.measurement.cir.samples)
        if size > 200 and data[size - 1 : size] != b"\n":
            assert isinstance(error, DamagedRecordingError)


def test_a_log_cut_in_an_accumulator_says_where(write):
    path = write(
        header(), exchange(1.0), received(0x21, SECOND, dump(ramp(0), length=1016)).rstrip("\n"), "\n"
    )
    records, error = read_until_damage(path)
    assert len(records) == 1
    assert isinstance(error, DamagedRecordingError)
    assert error.what == "the log ends after 6 of 1016 accumulator lines"
    lines = path.read_bytes().count(b"\n")
    assert error.where == f"{path}: after line {lines}"


def _noisy(count: int) -> list[str]:
    rng = np.random.default_rng(5)
    noise = [[tuple(pair) for pair in rng.integers(-900, 900, (1016, 2)).tolist()] for _ in range(2 * count)]
    return [
        poll(i * SECOND, noise[2 * i]) + TRANSMIT + final(i * SECOND + 9, noise[2 * i + 1]) + ranged(float(i))
        for i in range(count)
    ]


def test_an_xz_stream_cut_short_yields_what_was_before(write):
    path = write(header(), *_noisy(12), name="7.log.xz")
    data = path.read_bytes()
    for size in range(0, len(data), len(data) // 16):
        path.write_bytes(data[:size])
        records, error = read_until_damage(path)
        assert [record.measurement.range_m for record in records] == list(map(float, range(len(records))))
        assert len(records) == lzma.LZMADecompressor().decompress(data[:size]).count(b"ppm\r\n")
        assert error is not None
        assert str(path) in error.where
        assert isinstance(error, DamagedRecordingError) or size < 64


def test_a_corrupt_xz_stream_yields_nothing_false(write):
    path = write(header(), *_noisy(12), name="7.log.xz")
    whole, _ = read(path)
    data = path.read_bytes()
    rng = np.random.default_rng(6)
    for at in rng.integers(len(data) // 4, len(data), 12).tolist():
        path.write_bytes(data[:at] + bytes([data[at] ^ 0x10]) + data[at + 1 :])
        records, error = read_until_damage(path)
        assert isinstance(error, DamagedRecordingError)
        assert "xz stream is corrupt" in error.what
        assert len(records) >= 12 * at // len(data) - 2
        for got, expected in zip(records, whole, strict=False):
            assert got.measurement.range_m == expected.measurement.range_m
            assert np.array_equal(got.measurement.cir.samples, expected.measurement.cir.samples)


def test_xz_streams_may_follow_each_other_with_padding(tmp_path):
    path = tmp_path / "7.log.xz"
    parts = [header() + exchange(1.0), exchange(2.0, 1.0)]
    path.write_bytes(b"\0\0\0\0".join(lzma.compress(part.replace("\n", "\r\n").encode()) for part in parts))
    records, _ = read(path)
    assert [record.measurement.range_m for record in records] == [1.0, 2.0]


@pytest.mark.parametrize(
    ("name", "data", "what"),
    [
        ("a.log", b"", "the log is empty"),
        ("a.log.xz", b"", "the log is empty"),
        ("a.log.xz", lzma.compress(b""), "the log is empty"),
        ("a.log", b"time,range\r\n0.1,5.0\r\n", "not a DecaRanging log"),
        ("a.log", bytes(range(256)) * 999, "not a DecaRanging log"),
        ("a.log.xz", b"File: of something else", "not an xz stream"),
        ("a.log.xz", XZ_MAGIC + bytes(range(200)), "the xz stream is corrupt"),
    ],
)
def test_what_is_no_log_is_refused_by_name(tmp_path, name, data, what):
    path = tmp_path / name
    path.write_bytes(data)
    with pytest.raises(RecordingError, match=what) as caught:
        list(DecaRangingLog(path))
    assert str(path) in caught.value.where


def test_a_log_that_is_not_there_is_refused(tmp_path):
    with pytest.raises(RecordingError, match="no such file"):
        list(DecaRangingLog(tmp_path / "7.log"))
    with pytest.raises(RecordingError, match="no such file"):
        open_decaranging(tmp_path / "7.log")


# ---- closing and memory ----


def test_closing_ends_an_iteration_and_releases_the_file(write):
    log = DecaRangingLog(write(header(), *_noisy(12)))
    records = iter(log)
    next(records)
    log.close()
    log.close()
    assert list(records) == []
    with pytest.raises(RecordingError, match="closed"):
        list(log)


@pytest.mark.parametrize("name", ["7.log", "7.log.xz"])
def test_memory_does_not_grow_with_the_log(write, name):
    def peak(repeats: int) -> int:
        log = DecaRangingLog(write(header(), *(_noisy(4) * repeats), name=name))
        tracemalloc.start()
        try:
            count = sum(1 for _ in log)
            assert count == 4 * repeats
            return tracemalloc.get_traced_memory()[1]
        finally:
            tracemalloc.stop()

    peak(1)
    assert peak(20) < peak(2) + 64 * 1024


def test_memory_does_not_grow_with_a_line(write):
    path = write(header(), "4" * 3_000_000 + "\n", exchange(5.0))
    tracemalloc.start()
    try:
        assert len(read(path)[0]) == 1
        assert tracemalloc.get_traced_memory()[1] < 1_000_000
    finally:
        tracemalloc.stop()


# ---- folders and surveys ----


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
def test_a_folder_gives_truth_and_locations(surveyed, inside):
    records = list(open_decaranging(surveyed / inside))
    assert [record.truth for record in records[::2]] == [
        Truth(5.0, "NDP NLOS", "flat/3"),
        Truth(0.0, "", "flat/4"),
    ]
    assert [(r.measurement.tag_id, r.measurement.anchor_id) for r in records[::2]] == [(1, 2), (1, 1)]


def test_one_log_of_a_surveyed_folder_gets_its_truth(surveyed):
    log = open_decaranging(surveyed / "logs" / "3.log.xz")
    assert next(iter(log)).truth == Truth(5.0, "NDP NLOS", "flat/3")


def test_logs_of_a_folder_follow_each_other_in_time(surveyed):
    folder = DecaRangingFolder(surveyed)
    records = list(folder)
    stamps = [record.measurement.stamp_ns for record in records]
    assert stamps == sorted(stamps)
    assert [record.measurement.sequence for record in records] == [0, 1, 2, 3]
    assert only(folder.skipped, Oddity.MOVED)  # both state the same start


def test_a_log_without_a_survey_row_keeps_its_addresses(surveyed, write):
    write(header(), exchange(9.0), name="flat/logs/5.log")
    folder = DecaRangingFolder(surveyed)
    last = list(folder)[-1]
    assert last.truth is None
    assert (last.measurement.tag_id, last.measurement.anchor_id) == (TAG, ANCHOR)
    assert folder.skipped[Oddity.NO_TRUTH.value] == 1


def test_a_folder_without_a_survey_is_read(write, tmp_path):
    write(header(), exchange(1.0), name="bare/20180108-131343_All.log")
    (record,) = DecaRangingFolder(tmp_path / "bare")
    assert record.truth is None


def test_a_log_there_twice_is_read_once(surveyed, write):
    write(header(), exchange(7.0), name="flat/logs/3.log")
    folder = DecaRangingFolder(surveyed)
    assert [record.measurement.range_m for record in folder] == [7.0, 2.0, 2.5]
    assert folder.skipped[Oddity.TWICE.value] == 1


def test_a_damaged_log_does_not_keep_the_others_from_being_read(surveyed, write):
    path = surveyed / "logs" / "3.log.xz"
    path.write_bytes(path.read_bytes()[:-30])
    folder = DecaRangingFolder(surveyed)
    ranges = []
    with pytest.raises(DamagedRecordingError, match="cut short") as caught:
        ranges.extend(record.measurement.range_m for record in folder)
    assert str(path) in caught.value.where
    assert ranges[-2:] == [2.0, 2.5]
    assert folder.skipped[Oddity.UNREADABLE.value] == 1


@pytest.mark.parametrize(
    ("name", "text", "what"),
    [
        ("pairs.csv", "file_number,anchor\n3,2\n", "anchor_location is absent"),
        ("pairs.csv", "file_number,anchor_location,tag_location\n3,2\n", "too short"),
        (
            "pairs.csv",
            "file_number,anchor_location,tag_location\n3,9,1\n",
            "anchor location 9 was not surveyed",
        ),
        ("pairs.csv", "file_number,anchor_location,tag_location\nx,2,1\n", "'x' is not a number"),
        ("pairs.csv", "file_number,anchor_location,tag_location\n3,2,1\n3,1,1\n", "3 is there twice"),
        ("anchors.csv", "location,x,y\n1,0,nan\n2,0,0\n", "'nan' is not finite"),
        ("tags.csv", None, "no such file"),
        ("labels.csv", "\xff\0" * 99, "not a CSV file"),
        ("tags.csv", "location,x,y\n" * 100_000, "more than"),
    ],
)
def test_a_malformed_survey_is_refused_by_file(surveyed, name, text, what):
    if text is None:
        (surveyed / name).unlink()
    else:
        (surveyed / name).write_bytes(text.encode("latin-1"))
    with pytest.raises(RecordingError, match=what) as caught:
        open_decaranging(surveyed)
    assert name in caught.value.where


def test_a_folder_without_logs_is_refused(tmp_path):
    with pytest.raises(RecordingError, match="holds no logs"):
        open_decaranging(tmp_path)


# ---- the real recordings ----


def naive(data: bytes) -> tuple[Counter[str], list[tuple[float, list[bytes] | None]]]:
    """An independent reading, line by line: oddities, and of each exchange the range and the final's CIR."""
    counts: Counter[str] = Counter()
    exchanges: list[tuple[float, list[bytes] | None]] = []
    seen = ""
    samples: list[bytes] | None = None
    lines = data.split(b"\r\n")
    for i, line in enumerate(lines):
        if not line[:1].isalpha():
            continue
        if line.startswith(b"RX DATA: "):
            kind = {b"21": "P", b"29": "F"}[line[9 + 42 : 9 + 44]]
            counts[Oddity.RETRIED_POLL.value] += kind == "P" and "P" in seen
            seen += kind
            if kind == "F":
                at = i + 4
                assert lines[i + 3] == b"Accum Len 1016"
                samples = lines[at : at + 1016]
        elif line.startswith(b"RX E"):
            coded = line[4:5] == b"C"
            counts[(Oddity.RECEPTION_ERROR_CODED if coded else Oddity.RECEPTION_ERROR).value] += 1
        elif line.startswith(b"TX Frame"):
            counts[Oddity.TRANSMIT_AFTER_FINAL.value] += "F" in seen
        elif line.startswith(b"Anchor ToF"):
            fields = dict(re.findall(rb"(\w+): (-?[\d.]+) m", line))
            distance, raw, bias = (float(fields[name]) for name in (b"Dist", b"DistRaw", b"Bias"))
            assert distance == pytest.approx(raw - bias, abs=1e-6)
            counts[Oddity.RANGE_BEFORE_FRAMES.value] += not seen
            exchanges.append((distance, samples))
            seen, samples = "", None
        if b"#INF" in line:
            counts[Oddity.POWER_NOT_A_NUMBER.value] += 1
    counts[Oddity.UNFINISHED.value] += bool(seen)
    return +counts, exchanges


ODD_LOGS = (6, 11, 27, 29, 36, 37, 46)
"""Of the real logs, those with an oddity of their own (the data's README names them)."""


@pytest.mark.slow
def test_the_real_logs_equal_a_naive_reading(apartment):
    total: Counter[str] = Counter()
    for path in (apartment / "logs" / f"{number}.log.xz" for number in (*ODD_LOGS, 19)):
        counts, exchanges = naive(lzma.decompress(path.read_bytes()))
        with open_decaranging(path) as log:
            measurements = [record.measurement for record in log]
        assert dict(log.skipped) == dict(counts), path.name
        assert len(measurements) == len(exchanges)
        assert [measurement.range_m for measurement in measurements] == [range_m for range_m, _ in exchanges]
        for measurement, (_, lines) in list(zip(measurements, exchanges, strict=True))[::8]:
            expected = [int(value) for line in lines or [] for value in line.split(b", ")]
            assert measurement.cir.samples.tolist() == expected
        total += counts
    assert total[Oddity.RECEPTION_ERROR_CODED.value] == 19
    assert total[Oddity.POWER_NOT_A_NUMBER.value] == 2


@pytest.mark.slow
def test_the_real_folder_is_in_order_of_time_and_has_all_truth(apartment_reading):
    records = apartment_reading.records
    assert len(records) == 4151
    stamps = np.array([record.measurement.stamp_ns for record in records])
    assert (np.diff(stamps) >= 0).all()
    assert Oddity.MOVED.value not in apartment_reading.skipped
    truths = {record.truth.configuration: record.truth for record in records if record.truth is not None}
    assert len(truths) == 28
    nineteen = truths["evk1000_apartment/19"]
    assert nineteen.range_m == pytest.approx(math.hypot(7.76 - 3.46, 6.79 - 6.4))
    assert nineteen.label == "NDP NLOS"
    errors = [r.measurement.range_m - r.truth.range_m for r in records if r.truth and r.truth.label == "LOS"]
    assert np.median(errors) == pytest.approx(0.22, abs=0.05)


def test_a_real_log_keeps_time_by_the_radios_counter(apartment):
    with open_decaranging(apartment / "logs" / "19.log.xz") as log:
        measurements = [record.measurement for record in log]
    steps = np.diff([measurement.stamp_ns for measurement in measurements]) / 1e9
    assert ((steps > 0.5) & (steps < 5.0)).all()
    assert measurements[0].stamp_ns == pytest.approx(START_NS + 0.35e9, abs=1e6)
    assert measurements[0].cir.first_path_index == 749.25
    assert (measurements[0].tag_id, measurements[0].anchor_id) == (6, 2)
