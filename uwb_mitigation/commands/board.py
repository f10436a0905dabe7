"""`uwb-mitigation board`: the antenna delay of radios, and the firmware of boards."""

from __future__ import annotations

from dataclasses import asdict
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from uwb_mitigation.commands.support import console
from uwb_mitigation.commands.support.console import ConsoleTable, JsonOption, print_line
from uwb_mitigation.errors import ModelError, ParameterError, parse_id
from uwb_mitigation.files import write_atomically

if TYPE_CHECKING:
    from uwb_mitigation.radios.dw1000.antenna_delay import AntennaDelay
    from uwb_mitigation.radios.settings import RadioSettings

ModelOption = Annotated[
    Path | None, typer.Option(help="Int8 bundle. Default: the shipped one.", show_default=False)
]

app = typer.Typer(help="Calibrate radios, build firmware.", no_args_is_help=True)


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
    from uwb_mitigation.radios.dw1000.antenna_delay import measure
    from uwb_mitigation.radios.dw1000.bus import bus_opener

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
    from uwb_mitigation.radios.settings import RadioSettings

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


def _table(found: AntennaDelay, distance_m: float, radios: int) -> ConsoleTable:
    table = ConsoleTable(f"{found.ranges} ranges over {distance_m:g} m", "")
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
    from uwb_mitigation.mitigation.embedded.export import GOLDEN_VECTORS, export_bundle
    from uwb_mitigation.mitigation.model.bundle import load_bundle
    from uwb_mitigation.mitigation.model.shipped import model_path
    from uwb_mitigation.types.measurement import RadioType

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

    from uwb_mitigation.mitigation.embedded import toolchain
    from uwb_mitigation.mitigation.embedded.export import export_bundle
    from uwb_mitigation.mitigation.model.bundle import load_bundle
    from uwb_mitigation.mitigation.model.shipped import model_path

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
