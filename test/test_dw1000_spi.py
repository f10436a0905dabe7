"""An independent driver, PyPI `dw1000-spi`, on the model, of which it knows nothing: it initialises, sends, receives, ranges."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from compilers import NEEDS_CC
from dw1000_driver import TICK_M, WRAP
from spidev_on_model import dw1000, program, replace_spidev

from benchmarks.dw1000_model.air import Air, Host
from benchmarks.dw1000_model.links import Link

pytestmark = NEEDS_CC


@pytest.fixture
def air(monkeypatch: pytest.MonkeyPatch) -> Iterator[Air]:
    replace_spidev(monkeypatch)
    with Air(2) as air:
        yield air


def test_it_initialises_and_reads_the_identity(air: Air):
    seen = []
    chip = air.chip()
    air.program(chip, program(lambda driver, _: seen.append(driver.read_register([0], 4, return_ints=True))))
    air.run(1.0)
    assert seen == [[0x30, 0x01, 0xCA, 0xDE]]


def test_it_comes_back_from_its_own_soft_reset(air: Air):
    seen = []

    def reset(driver: dw1000.DW1000, _: Host) -> None:
        driver.soft_reset()
        seen.append(driver.read_register([0x04], 4, return_ints=True))

    air.program(air.chip(), program(reset))
    air.run(1.0)
    assert seen == [[0x00, 0x12, 0x04, 0x00]]


@pytest.mark.parametrize(("channel", "prf"), [(5, 64), (2, 64), (5, 16)])
def test_it_sends_and_receives(air: Air, channel: int, prf: int):
    a, b = air.chip(), air.chip()
    air.link(a, b, Link(7.0))
    heard = []
    sent = []

    def send(driver: dw1000.DW1000, host: Host) -> None:
        host.delay(20e-3)
        sent.append(driver.transmit([1, 2, 3], ranging=True))

    air.program(a, program(send, channel, prf))
    air.program(b, program(lambda driver, _: heard.append(driver.listen(True, 0.1)), channel, prf))
    air.run(1.0)
    ((done, stamp),) = sent
    ((data, arrived),) = heard
    assert done
    assert data == [1, 2, 3]
    assert arrived - stamp == pytest.approx(7.0 / TICK_M, abs=1)


def test_it_receives_again_after_damage_and_loss(air: Air):
    a, b = air.chip(), air.chip()
    air.link(a, b, Link(7.0, loss=0.2, damage=0.3))
    heard = []

    def send(driver: dw1000.DW1000, host: Host) -> None:
        for number in range(60):
            host.delay(5e-3)
            assert driver.transmit([number], ranging=False)

    def listen(driver: dw1000.DW1000, _: Host) -> None:
        heard.extend(driver.listen(timeout=10e-3) for _ in range(60))

    air.program(a, program(send))
    air.program(b, program(listen))
    air.run(2.0)
    numbers = [data[0] for data in heard if data]
    assert numbers == sorted(set(numbers))
    assert 20 < len(numbers) < 50


@pytest.mark.parametrize("distance_m", [0.3, 12.0, 100.0])
@pytest.mark.parametrize("ppm", [(-20.0, 20.0), (20.0, -20.0)])
def test_two_of_them_range(air: Air, distance_m: float, ppm: tuple[float, float]):
    """The driver has no delayed send: the stamps of all three frames travel in a fourth."""
    a, b = (air.chip(ppm=p, clock_ticks=c) for p, c in zip(ppm, (WRAP - 10**9, 0), strict=True))
    air.link(a, b, Link(distance_m, excess_m=0.25))
    ranges = []

    def initiate(driver: dw1000.DW1000, host: Host) -> None:
        for _ in range(10):
            host.delay(3e-3)
            _, polled = driver.transmit([1], ranging=True)
            answer, answered = driver.listen(True)
            assert answer == [2]
            host.delay(0.3e-3)
            _, final = driver.transmit([3], ranging=True)
            report, _ = driver.listen(True)
            their = [int.from_bytes(bytes(report[1 + 5 * k : 6 + 5 * k]), "little") for k in range(3)]
            round_1, reply_2 = (answered - polled) % WRAP, (final - answered) % WRAP
            reply_1, round_2 = (their[1] - their[0]) % WRAP, (their[2] - their[1]) % WRAP
            flight = (round_1 * round_2 - reply_1 * reply_2) / (round_1 + round_2 + reply_1 + reply_2)
            ranges.append(flight * TICK_M)

    def respond(driver: dw1000.DW1000, host: Host) -> None:
        for _ in range(10):
            _, polled = driver.listen(True, 0.1)
            host.delay(0.3e-3)
            _, answered = driver.transmit([2], ranging=True)
            _, final = driver.listen(True)
            host.delay(0.3e-3)
            stamps = b"".join(stamp.to_bytes(5, "little") for stamp in (polled, answered, final))
            driver.transmit([4, *stamps], ranging=False)

    air.program(a, program(initiate))
    air.program(b, program(respond))
    air.run(1.0)
    assert len(ranges) == 10
    assert ranges == pytest.approx([distance_m + 0.25] * 10, abs=0.01)
    assert sum(ranges) / 10 == pytest.approx(distance_m + 0.25, abs=0.005)
