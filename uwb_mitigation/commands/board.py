"""`uwb-mitigation board`: an emulated board, the antenna delay of radios, and the firmware of boards."""

from __future__ import annotations

import math
import time
from dataclasses import asdict, replace
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from uwb_mitigation.commands import console
from uwb_mitigation.commands.console import JsonOption, Table, print_line
from uwb_mitigation.errors import ModelError, ParameterError, check_name, parse_id
from uwb_mitigation.files import write_atomically

if TYPE_CHECKING:
    from uwb_mitigation.link.messages import Hello
    from uwb_mitigation.link.radio_settings import RadioSettings
    from uwb_mitigation.mitigation import Mitigation
    from uwb_mitigation.radio.antenna_delay import AntennaDelay
    from uwb_mitigation.sources.source import Source

ModelOption = Annotated[
    Path | None, typer.Option(help="Int8 bundle. Default: the shipped one.", show_default=False)
]

app = typer.Typer(help="Emulate a board, calibrate radios, build firmware.", no_args_is_help=True)


@app.command()
def emulate(
    recording: Annotated[
        Path | None,
        typer.Argument(
            metavar="[RECORDING]", help="Recording that is played in a loop. Default: simulated ranges."
        ),
    ] = None,
    link: Annotated[Path | None, typer.Option(help="Symbolic link to the port while the board runs.")] = None,
    rate: Annotated[float, typer.Option(help="Rate of the measurements, Hz.")] = 50.0,
    model: Annotated[Path | None, typer.Option(help="Bundle on the board.")] = None,
    mode: Annotated[str, typer.Option(help="Initial mode: host or device.")] = "host",
    duration: Annotated[float | None, typer.Option(help="Duration, s. Default: until Ctrl-C.")] = None,
    damage: Annotated[
        float, typer.Option(help="Share of bytes that are flipped, dropped and inserted, each.")
    ] = 0.0,
    lose: Annotated[float, typer.Option(help="Share of lost messages.")] = 0.0,
    duplicate: Annotated[float, typer.Option(help="Share of duplicated messages.")] = 0.0,
    seed: Annotated[int, typer.Option(help="Seed of the faults and of simulated measurements.")] = 1,
    json: JsonOption = None,
) -> None:
    """Emulate a board on a pseudo-terminal.

    Open the printed port like /dev/ttyACM0.
    """
    from uwb_mitigation.link.emulated_board import EmulatedBoard
    from uwb_mitigation.link.faults import Faults
    from uwb_mitigation.link.layout import Mode

    check_name("mode", mode, ("host", "device"))
    if duration is not None and not duration > 0:
        raise ParameterError(f"duration = {duration}", valid="above 0")
    if seed < 0:
        raise ParameterError(f"seed = {seed}", valid="0 or more")
    faults = Faults(damage, damage, damage, lose, duplicate)
    identity, mitigation = _firmware(model)
    with open_source(recording, rate, seed) as source:
        board = EmulatedBoard(
            source,
            rate_hz=rate,
            identity=identity,
            corrector=mitigation,
            mode=Mode[mode.upper()],
            faults=faults,
            link=link,
            seed=seed,
        )
        with board:
            print_line(f"{source.name} at {board.port}")
            end_s = time.monotonic() + (duration or math.inf)
            while board.failure is None and time.monotonic() < end_s:
                time.sleep(0.05)
    console.write_json(json, {"sent": board.sent_measurements})
    if board.failure is not None:
        raise board.failure


def open_source(recording: Path | None, rate: float, seed: int) -> Source:
    """Return the source of measurements: a recording, or the simulator without one."""
    if recording is None:
        from uwb_mitigation.sources.simulated import SimulatedSource

        return SimulatedSource(seed=seed, rate_hz=rate)
    from uwb_mitigation.sources.opening import open_recording

    return open_recording(recording)


def _firmware(model: Path | None) -> tuple[Hello, Mitigation | None]:
    from uwb_mitigation.link.emulated_board import EMULATED

    if model is None:
        return EMULATED, None
    from uwb_mitigation.mitigation import Mitigation
    from uwb_mitigation.model.bundle import load_bundle

    bundle = load_bundle(model)
    return replace(EMULATED, model_id=bundle.model_id, window=bundle.preprocessing.samples), Mitigation(
        bundle
    )


class RadioSource(str, Enum):
    """Interface between this computer and the chip."""

    EVB1000 = "evb1000"
    SPI = "spi"


@app.command()
def antenna_delay(
    distance: Annotated[
        float, typer.Option(help="Distance between the antennas, m, measured to the centimetre.")
    ],
    port: Annotated[
        str,
        typer.Option(
            metavar="P[,P2]",
            help="Port of the tag, and of the anchor if it is also on this computer: /dev/ttyACM0, usb:0483:5740, "
            "/dev/spidev0.0.",
        ),
    ],
    source: Annotated[
        RadioSource, typer.Option(help="Kind of radio, as in the driver.")
    ] = RadioSource.EVB1000,
    reset: Annotated[str, typer.Option(help="Reset line of the chip, such as gpiochip0:25 (spi).")] = "",
    anchor: Annotated[
        str | None,
        typer.Option(
            metavar="ADDRESS",
            help="Address of the anchor if several answer: 34 or 0xdeca010203040506.",
        ),
    ] = None,
    exchanges: Annotated[int, typer.Option(min=20, max=100_000, help="Number of ranges.")] = 200,
    channel: Annotated[
        int, typer.Option(help="Channel, 1 to 5 or 7; a delay is valid for one channel and PRF.")
    ] = 5,
    prf: Annotated[int, typer.Option(help="Pulse repetition frequency, 16 or 64 MHz.")] = 64,
    preamble: Annotated[int, typer.Option(help="Preamble length, symbols.")] = 128,
    data_rate: Annotated[int, typer.Option(help="Data rate: 110, 850 or 6800 kbit/s.")] = 6800,
    start: Annotated[
        int,
        typer.Option(help="Antenna delay during the measurement, ticks; 0: value from OTP, or 2 x 16436."),
    ] = 0,
    output: Annotated[
        Path | None,
        typer.Option(
            "-o", "--output", metavar="FILE", help="Parameter file for the driver, which is written."
        ),
    ] = None,
    json: JsonOption = None,
) -> None:
    """Calibrate a pair of radios over a known distance.

    Place both in line of sight of each other, well above the floor, at a measured distance: 5.01 m suits
    channel 5 (Decawave APS014). No driver may have the ports open. With two ports, both radios get the
    same delay; with one, the anchor keeps its delay, and the tag's delay compensates the complete error.

        uwb-mitigation board antenna-delay --distance 5.01 --port /dev/ttyACM0,/dev/ttyACM1 -o antenna_delay.yaml
    """
    from uwb_mitigation.radio.antenna_delay import measure
    from uwb_mitigation.radio.bus import bus_opener

    if not 0.3 <= distance <= 100.0:
        raise ParameterError(f"--distance {distance}", valid="0.3 to 100 m")
    ports = [part.strip() for part in port.split(",") if part.strip()]
    if not 1 <= len(ports) <= 2 or len(set(ports)) < len(ports):
        raise ParameterError(
            f"--port {port}", valid="the port of the tag, or the different ports of tag and anchor"
        )
    if output is not None and (output.is_dir() or not output.absolute().parent.is_dir()):
        raise ParameterError(f"-o {output}", valid="a file in an existing folder")
    settings = _settings(anchor, channel, prf, preamble, data_rate, start)
    openers = [bus_opener(source.value, port_name, reset) for port_name in ports]
    with console.step_bar("ranging", exchanges) as advance:
        found = measure(openers, settings, distance, exchanges, advance)
    console.out.print(_table(found, distance, len(ports)))
    content = _parameters(found, distance, port, settings)
    if output is None:
        console.out.print(content, end="", soft_wrap=True, highlight=False, markup=False)
    else:
        write_atomically(output, content)
        print_line(
            f"{output}: radio.antenna_delay {found.antenna_delay}; "
            f"ros2 run uwb_mitigation driver --ros-args --params-file {output} ..."
        )
    console.write_json(json, {"distance_m": distance, **asdict(found)})


def _settings(
    anchor: str | None, channel: int, prf: int, preamble: int, data_rate: int, start: int
) -> RadioSettings:
    from uwb_mitigation.link.radio_settings import RadioSettings

    try:
        anchors = () if anchor is None else (parse_id(anchor),)
    except ValueError:
        raise ParameterError(
            f"--anchor {anchor:.40}", valid="a number below 65536, or 0x and up to 16 hexadecimal digits"
        ) from None
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
    table.add_row("receive level minus first-path level, dB", f"{found.power_gap_db:.1f}")
    owner = "of both radios" if radios == 2 else "of the tag"
    table.add_row(f"previous antenna delay {owner}, ticks", f"{found.before:g}")
    table.add_row(f"new antenna delay {owner}, ticks", f"{found.antenna_delay}")
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


@app.command()
def export_c(
    output: Annotated[
        Path,
        typer.Option(
            "-o", "--output", metavar="DIR", help="Folder for uwb_model.h; created if it does not exist."
        ),
    ],
    model: ModelOption = None,
    json: JsonOption = None,
) -> None:
    """Write a model as a C header for the firmware.

    It contains weights, constants and golden vectors.
    """
    from uwb_mitigation.firmware_export.export import GOLDEN_VECTORS, export_bundle
    from uwb_mitigation.measurement import RadioType
    from uwb_mitigation.model.bundle import load_bundle
    from uwb_mitigation.model.shipped import model_path

    bundle = load_bundle(model_path(model))
    if RadioType.DW1000 not in bundle.card.radios:
        trained_for = f"the firmware drives a DW1000, and the model was trained for {bundle.card.source}"
        raise ModelError(trained_for, where=str(bundle.path), valid="a model for the DW1000")
    header = export_bundle(bundle, output)
    result = {
        "header": str(header),
        "model_id": bundle.model_id,
        "k": bundle.architecture.samples,
        "parameters": bundle.architecture.parameters,
        "golden_vectors": GOLDEN_VECTORS,
    }
    print_line(f"{header}: model {bundle.model_id:08x}, K = {result['k']}, {result['parameters']} parameters")
    console.write_json(json, result)


@app.command()
def build_image(
    output: Annotated[
        Path,
        typer.Option(
            "-o", "--output", metavar="FILE.hex", help="Image file; copy it to the USB drive of the board."
        ),
    ] = Path("dwm1001-dev.hex"),
    model: ModelOption = None,
    json: JsonOption = None,
) -> None:
    """Build the DWM1001-DEV image as Intel HEX.

    It contains the ranging firmware with a model that corrects on the board. The board is an anchor unless its host, or
    its button pressed during start-up, makes it a tag. The image has not been run on a board; its driver and
    exchange were tested on a chip model.
    """
    import tempfile

    from uwb_mitigation.firmware_export import toolchain
    from uwb_mitigation.firmware_export.export import export_bundle
    from uwb_mitigation.model.bundle import load_bundle
    from uwb_mitigation.model.shipped import model_path

    if not output.absolute().parent.is_dir():
        raise ParameterError(f"--output {output}", valid="a file in an existing folder")
    bundle = load_bundle(model_path(model))
    with tempfile.TemporaryDirectory() as folder:
        export_bundle(bundle, Path(folder))
        image = toolchain.build_image(Path(folder), Path(folder), toolchain.Target.DWM1001_DEV)
        toolchain.write_hex(image, output)
    print_line(
        f"{output}: {image.flash_bytes:,} of {image.available_flash_bytes:,} bytes of flash, {image.static_bytes:,} of "
        f"{image.available_ram_bytes:,} of RAM, the rest for the stack; model {bundle.model_id:08x}"
    )
    result = asdict(image) | {
        "image": str(output),
        "ram_bytes": image.static_bytes,
        "model_id": bundle.model_id,
    }
    console.write_json(json, {name: value for name, value in result.items() if name != "elf"})
