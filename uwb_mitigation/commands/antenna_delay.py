"""`uwb-mitigation antenna-delay`: calibrates a pair of radios at this computer over a known distance."""

from __future__ import annotations

from dataclasses import asdict
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from uwb_mitigation.commands import console
from uwb_mitigation.commands.console import JsonOption, Table
from uwb_mitigation.errors import ParameterError
from uwb_mitigation.files import write_whole

if TYPE_CHECKING:
    from uwb_mitigation.link.radio import RadioSettings
    from uwb_mitigation.radio.antenna_delay import AntennaDelay


class RadioSource(str, Enum):
    """What hangs between this computer and the chip."""

    EVB1000 = "evb1000"
    SPI = "spi"


def antenna_delay(
    distance: Annotated[float, typer.Option(help="m, between the antennas, measured to the centimetre.")],
    port: Annotated[
        str,
        typer.Option(
            metavar="P[,P2]",
            help="Of the tag, and of the anchor if it is at this computer too: /dev/ttyACM0, usb:0483:5740, "
            "/dev/spidev0.0.",
        ),
    ],
    source: Annotated[RadioSource, typer.Option(help="As the driver's.")] = RadioSource.EVB1000,
    reset: Annotated[str, typer.Option(help="The chip's reset line, as gpiochip0:25 (spi).")] = "",
    anchor: Annotated[
        str | None,
        typer.Option(metavar="ADDRESS", help="Of the anchor, in hexadecimal, where several answer."),
    ] = None,
    exchanges: Annotated[int, typer.Option(min=20, max=100_000, help="Ranges to measure.")] = 200,
    channel: Annotated[int, typer.Option(help="1 to 5, or 7: a delay holds for one channel and PRF.")] = 5,
    prf: Annotated[int, typer.Option(help="16 or 64 MHz.")] = 64,
    preamble: Annotated[int, typer.Option(help="Symbols.")] = 128,
    data_rate: Annotated[int, typer.Option(help="110, 850 or 6800 kbit/s.")] = 6800,
    start: Annotated[
        int,
        typer.Option(
            help="Delay to range with meanwhile, ticks; 0 = as in the chip's memory, else 2 x 16436."
        ),
    ] = 0,
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", metavar="FILE", help="Parameter file for the driver, to write."),
    ] = None,
    json: JsonOption = None,
) -> None:
    """Calibrate a pair of radios over a known distance.

    Put both up in line of sight of each other, well above the floor, at a distance that you measured: 5.01 m suits
    channel 5 (Decawave APS014). A driver must not hold the ports. With two ports, both radios get the
    same delay; with one, the anchor keeps its own, and the tag takes all of what the ranges are off.

        uwb-mitigation antenna-delay --distance 5.01 --port /dev/ttyACM0,/dev/ttyACM1 -o antenna_delay.yaml
    """
    from uwb_mitigation.radio.antenna_delay import measure
    from uwb_mitigation.radio.opening import opener

    if not 0.3 <= distance <= 100.0:
        raise ParameterError(f"--distance {distance}", valid="0.3 to 100 m")
    places = [part.strip() for part in port.split(",") if part.strip()]
    if not 1 <= len(places) <= 2 or len(set(places)) < len(places):
        raise ParameterError(f"--port {port}", valid="the tag's, or the tag's and another one, the anchor's")
    if output is not None and (output.is_dir() or not output.absolute().parent.is_dir()):
        raise ParameterError(f"-o {output}", valid="a file, in a folder that is there")
    settings = _settings(anchor, channel, prf, preamble, data_rate, start)
    openers = [opener(source.value, place, reset) for place in places]
    with console.step_bar("ranging", exchanges) as advance:
        found = measure(openers, settings, distance, exchanges, advance)
    console.out.print(_table(found, distance, len(places)))
    content = _parameters(found, distance, port, settings)
    if output is None:
        console.out.print(content, end="", soft_wrap=True, highlight=False, markup=False)
    else:
        write_whole(output, content)
        console.out.print(
            f"{output}: radio.antenna_delay {found.antenna_delay}; "
            f"ros2 run uwb_mitigation driver --ros-args --params-file {output} ...",
            soft_wrap=True,
            highlight=False,
            markup=False,
        )
    console.write_json(json, {"distance_m": distance, **asdict(found)})


def _settings(
    anchor: str | None, channel: int, prf: int, preamble: int, data_rate: int, start: int
) -> RadioSettings:
    from uwb_mitigation.link.radio import RadioSettings

    try:
        anchors = () if anchor is None else (int(anchor, 16),)
    except ValueError:
        raise ParameterError(f"--anchor {anchor:.40}", valid="up to sixteen hexadecimal digits") from None
    settings = RadioSettings(
        channel=channel,
        prf_mhz=prf,
        preamble=preamble,
        rate_kbps=data_rate,
        anchors=anchors,
        antenna_delay=start,
    )
    settings.check()
    return settings


def _table(found: AntennaDelay, distance_m: float, radios: int) -> Table:
    table = Table(f"{found.ranges} ranges over {distance_m:g} m", "")
    table.columns[1].justify = "right"
    table.add_row("median error, m", f"{found.offset_m:+.4f}")
    table.add_row("standard deviation of a range, m", f"{found.sd_m:.4f}")
    table.add_row("received over first-path power, dB", f"{found.power_gap_db:.1f}")
    whose = "of both radios" if radios == 2 else "of the tag"
    table.add_row(f"antenna delay {whose} so far, ticks", f"{found.before:g}")
    table.add_row(f"antenna delay {whose} from now on, ticks", f"{found.antenna_delay}")
    return table


def _parameters(found: AntennaDelay, distance_m: float, port: str, settings: RadioSettings) -> str:
    return (
        f"# {found.ranges} ranges over {distance_m:g} m with {' '.join(port.split())}, off by {found.offset_m:+.4f} m "
        f"with {found.before:g} ticks.\n"
        f"# For channel {settings.channel}, PRF {settings.prf_mhz} MHz.\n"
        "/**:\n"
        "  ros__parameters:\n"
        f"    radio.antenna_delay: {found.antenna_delay}\n"
    )
