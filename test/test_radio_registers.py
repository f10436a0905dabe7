"""Register writes of the firmware's driver, compared with Decawave's driver."""

import ctypes
import itertools
from collections.abc import Callable, Iterator
from dataclasses import replace

import pytest
from compilers import NEEDS_CC
from firmware_on_model import ModelBus, ranging, use_virtual_time

from benchmarks.equipment.dw1000_model.air import Air, Chip, Host
from benchmarks.equipment.dw1000_model.pairs import Pair
from uwb_mitigation.errors import LinkError
from uwb_mitigation.radios.dw1000.native import Io, NativeRadio, load_native
from uwb_mitigation.radios.settings import RadioSettings, RadioState, RadioStatus, Role
from uwb_mitigation.radios.wire import messages
from uwb_mitigation.types.measurement import RangeMeasurement

pytestmark = NEEDS_CC

ANCHOR_ADDRESS = 0xA000000000000001
SYS_CTRL, SYS_STATUS, CPLOCK = 0x0D, 0x0F, 0x02
DEFAULT = RadioSettings()


@pytest.fixture
def air(monkeypatch: pytest.MonkeyPatch) -> Iterator[Air]:
    use_virtual_time(monkeypatch)
    with Air(3) as air:
        yield air


class Run:
    """Run tags and an anchor at a distance of 6 m; return their register writes."""

    def __init__(
        self,
        air: Air,
        settings: RadioSettings = DEFAULT,
        *,
        seconds: float = 0.12,
        tags: int = 1,
        bus: Callable[[Host], ModelBus] = ModelBus,
        prepare: Callable[[Chip], None] = lambda _: None,
    ) -> None:
        self.ranges: list[RangeMeasurement] = []
        self.radios: list[RadioSettings] = []
        self.statuses: list[RadioStatus] = []
        self.buses: list[ModelBus] = []
        anchor = replace(settings, role=Role.ANCHOR, address=ANCHOR_ADDRESS)
        tag = replace(settings, anchors=(ANCHOR_ADDRESS,))
        self.chips = [air.chip(ppm=4.0 * number) for number in range(1 + tags)]
        for number, chip in enumerate(self.chips):
            prepare(chip)
            for neighbour in self.chips[:number]:
                air.set_pair(chip, neighbour, Pair(6.0))
            options = {
                "bus": lambda host: self.buses.append(bus(host)) or self.buses[-1],
                "at_end": self._at_end,
            }
            air.program(chip, ranging(tag if number else anchor, self.ranges, seconds, **options))
        air.run(2 * seconds)

    def _at_end(self, radio: NativeRadio) -> None:
        self.radios.append(radio.settings)
        radio.read_sensors()
        self.statuses.append(radio.status())

    def start_up(self) -> list[tuple[int, int, bytes]]:
        """Return the writes of the anchor before its configuration is complete, which sets SYS_MASK."""
        writes = [write[1:] for write in self.buses[0].writes]
        end = next(row for row, (file, _, data) in enumerate(writes) if file == 0x0E and any(data))
        return writes[: next(row for row in range(end + 1, len(writes)) if writes[row][0] == 0x0E)]


COMMON = """
PANADR 03 0 4 5542A55A          AGC_TUNE2 23 0C 4 2502A907      AGC_TUNE3 23 12 2 0035
DRX_TUNE4H 27 26 2 0028         LDE_CFG1 2E 0806 1 6D           ACK_RESP_T 1A 0 3 000000
TX_ANTD 18 0 2 4034             LDE_RXANTD 2E 1804 2 4034       FS_XTALT 2B 0E 1 70
EC_CTRL 24 0 1 04               OTP_SF 2D 12 1 02               AON_CFG1 2C 0A 2 0000
"""
# {name: (settings, registers)}, each register with its name, file, sub-address, octets and value. The values are those of
# Decawave's tables and of the register log of its driver. The TX power words in the OTP memory of the modelled chip are in
# smart-power format.
CONFIGURATIONS = {
    "channel 5, 64 MHz, 6.8 Mbit/s": (
        RadioSettings(),
        """
SYS_CFG 04 0 4 00001200         TX_POWER 1E 0 4 25456585        CHAN_CTRL 1F 0 4 4A480055
RF_TXCTRL 28 0C 4 001E3FE3      TC_PGDELAY 2A 0B 1 B5           RF_RXCTRLH 28 0B 1 D8
FS_PLLCFG 2B 07 4 0800041D      FS_PLLTUNE 2B 0B 1 BE           AGC_TUNE1 23 04 2 889B
DRX_TUNE0b 27 02 2 0001         DRX_TUNE1a 27 04 2 008D         DRX_TUNE1b 27 06 2 0020
DRX_TUNE2 27 08 4 313B006B      DRX_SFDTOC 27 20 2 0081         LDE_CFG2 2E 1806 2 0607
LDE_REPC 2E 2804 2 28F4         USR_SFD 21 0 1 08
""",
    ),
    "channel 2, 16 MHz, 110 kbit/s": (
        RadioSettings(channel=2, prf_mhz=16, rate_kbps=110, preamble=1024),
        """
SYS_CFG 04 0 4 00441200         TX_POWER 1E 0 4 75757575        CHAN_CTRL 1F 0 4 18C40022
RF_TXCTRL 28 0C 4 00045CA0      TC_PGDELAY 2A 0B 1 C2           RF_RXCTRLH 28 0B 1 D8
FS_PLLCFG 2B 07 4 08400508      FS_PLLTUNE 2B 0B 1 26           AGC_TUNE1 23 04 2 8870
DRX_TUNE0b 27 02 2 000A         DRX_TUNE1a 27 04 2 0087         DRX_TUNE1b 27 06 2 0064
DRX_TUNE2 27 08 4 351A009A      DRX_SFDTOC 27 20 2 0421         LDE_CFG2 2E 1806 2 1607
LDE_REPC 2E 2804 2 0A3D         USR_SFD 21 0 1 40
""",
    ),
}


def expected(registers: str) -> dict[tuple[int, int], bytes]:
    """Return {(register file, sub-address): octets} of a table."""
    found = {}
    for _, file, sub, octets, value in zip(*[iter(registers.split())] * 5, strict=True):
        found[int(file, 16), int(sub, 16)] = int(value, 16).to_bytes(int(octets), "little")
    return found


@pytest.mark.parametrize("name", CONFIGURATIONS)
def test_every_register_write_at_the_start_is_that_of_the_table(air: Air, name: str):
    settings, registers = CONFIGURATIONS[name]
    writes = Run(air, settings).start_up()
    commands, otp = {0x0D, 0x0E, SYS_STATUS, 0x36}, {(0x2D, 0x04), (0x2D, 0x06)}
    configured = {(file, sub): data for file, sub, data in writes if file not in commands}
    assert {key: data for key, data in configured.items() if key not in otp} == expected(COMMON + registers)
    # The clocks change octet by octet, and CPLOCK is cleared before the PLL starts.
    cleared = (SYS_STATUS, 0, b"\x02\0\0\0")
    clocks = [(file, sub, data) for file, sub, data in writes if file == 0x36 or data == cleared[2]]
    before, after = ((0, b"\x01"), (0, b"\x01"), (1, b"\x03")), ((0, b"\x00"), (1, b"\x02"))
    assert clocks == [*((0x36, *each) for each in before), cleared, *((0x36, *each) for each in after)]
    # TXSTRT with TRXOFF initialises the SFD logic and sends nothing.
    assert [data for file, _, data in writes if file == SYS_CTRL][-1] == b"\x42\0\0\0"


@pytest.mark.parametrize(
    ("settings", "boost_db"),
    [
        (RadioSettings(), 6.0),  # up to 250 us
        (RadioSettings(preamble=256), 3.0),
        (RadioSettings(preamble=1024), 0.0),
        (RadioSettings(channel=2, prf_mhz=16, preamble=2048), 0.0),
        (RadioSettings(rate_kbps=110, preamble=1024), 0.0),
        (RadioSettings(rate_kbps=110, preamble=1024, tx_power=0x25456585), 0.0),
    ],
    ids=lambda value: f"{value.rate_kbps}-{value.preamble}" if isinstance(value, RadioSettings) else None,
)
def test_no_frame_exceeds_the_calibrated_power(air: Air, settings: RadioSettings, boost_db: float):
    run = Run(air, settings)
    assert run.ranges
    calibrated_db = 19.5 if settings.channel == 2 else 8.5  # OTP, octet for frames of any length: 0x75, 0x85
    for chip in run.chips:
        assert chip.sent_power_db == (calibrated_db + boost_db,) * 2


class FastBus(ModelBus):
    """A bus that detects the end of a frame immediately."""

    def pause(self) -> None:
        self._host.delay(5e-6)


def test_smart_power_sends_one_frame_per_millisecond(air: Air):
    run = Run(air, RadioSettings(preamble=64, window=0), tags=3, seconds=0.15, bus=FastBus)
    assert len(run.ranges) > 5
    starts = [row for row, file, _, data in run.buses[0].writes if file == SYS_CTRL and data[0] & 0x42 == 2]
    assert min(later - earlier for earlier, later in itertools.pairwise(starts)) >= 1e-3


@pytest.mark.parametrize(
    ("settings", "tag", "anchor", "revision"),
    [
        (RadioSettings(channel=2), 2 * 0x4011, 2 * 0x4111, 2),
        (RadioSettings(channel=5), 2 * 0x4033, 2 * 0x4133, 2),
        (RadioSettings(channel=5, rate_kbps=110, preamble=1024), 2 * 0x4044, 2 * 0x4144, 2),
        (RadioSettings(channel=5, rate_kbps=850), 0x8050, 0x8050, 2),
        (RadioSettings(channel=3), 0x8050, 0x8050, 2),
        (RadioSettings(channel=2, antenna_delay=32_700), 32_700, 32_700, 2),
        # Only revisions 2 and 3 are those of a TREK1000.
        (RadioSettings(), 0x8050, 0x8050, 1),
        (RadioSettings(), 2 * 0x4033, 2 * 0x4133, 3),
    ],
)
def test_antenna_delay_of_a_trek1000_is_from_otp(
    air: Air, settings: RadioSettings, tag: int, anchor: int, revision: int
):
    words = {0x0D: 0x4111_4011, 0x0E: 0x4122_4022, 0x0F: 0x4133_4033, 0x1D: 0x4144_4044, 0x1C: 0x8050_8060}

    def prepare(chip: Chip) -> None:
        for address, word in (words | {0x1E: revision << 8 | 0x10}).items():
            chip.program_otp(address, word)

    run = Run(air, settings, seconds=0.03, prepare=prepare)
    delays = {radio.role: radio.antenna_delay for radio in run.radios}
    assert (delays[Role.ANCHOR], delays[Role.TAG]) == (anchor, tag)


@pytest.mark.parametrize(("rate_kbps", "refused"), [(6800, True), (850, False)])
def test_reply_within_the_pause_of_smart_power_is_refused(rate_kbps: int, refused: bool):
    """FINAL must not be sent within 1 ms after POLL with more power than the average limit."""
    _, payload = messages.encode(RadioSettings(rate_kbps=rate_kbps, preamble=64, reply_us=999))
    settings = payload, len(payload), 0, 0
    radio = load_native().native_radio_new(ctypes.byref(Io()), *settings, 1)
    assert (load_native().native_radio_configure(radio, *settings) is not None) == refused
    load_native().native_radio_free(radio)


@pytest.mark.parametrize(
    ("radio", "edge_loss", "count"),
    [
        ({}, 0.2, 6),
        # The default delays grow with the length of the frames.
        *(({"rate_kbps": 110, "preamble": preamble}, 0.0, 3) for preamble in (1024, 4096)),
    ],
)
def test_frames_without_a_leading_edge_or_long_ones_yield_no_wrong_range(
    air: Air, radio: dict[str, int], edge_loss: float, count: int
):
    run = Run(air, RadioSettings(**radio), seconds=0.6, prepare=lambda chip: chip.set_edge_loss(edge_loss))
    assert len(run.ranges) >= count
    assert all(measured.range_m == pytest.approx(6.0, abs=0.03) for measured in run.ranges)


class NoLockBus(ModelBus):
    """The chip never reports CPLOCK."""

    def transfer(self, header: bytes, out: bytes | None, count: int) -> bytes:
        answer = super().transfer(header, out, count)
        if out is None and header[0] & 0x3F == SYS_STATUS:
            return bytes((answer[0] & ~CPLOCK,)) + answer[1:]
        return answer


class NoClockBus(NoLockBus):
    """The PLL of the chip does not lock: it ignores SPI at full speed."""

    def transfer(self, header: bytes, out: bytes | None, count: int) -> bytes:
        if self._hz < 3e6:
            return super().transfer(header, out, count)
        return bytes(count if out is None else len(out))


def test_unreported_pll_lock_is_a_warning(air: Air):
    run = Run(air, bus=NoLockBus)
    assert len(run.ranges) > 10
    for status in run.statuses:
        assert status.state is RadioState.LOCK_UNCONFIRMED
        assert "PLL" in status.warning


def test_unlocked_clock_is_an_error(air: Air):
    with pytest.raises(LinkError, match="clock"):
        Run(air, bus=NoClockBus)


def test_temperature_and_voltage_are_read_when_they_are_ready(air: Air):
    run = Run(air, seconds=0.05, prepare=lambda chip: chip.set_environment(41.0, 3.1))
    assert len(run.statuses) == 2
    for status in run.statuses:
        assert status.temperature_c == pytest.approx(41.0, abs=0.6)
        assert status.voltage == pytest.approx(3.1, abs=0.003)
