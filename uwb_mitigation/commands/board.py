"""`uwb-mitigation board`: the firmware of boards."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from uwb_mitigation.commands.support import console
from uwb_mitigation.commands.support.console import JsonOption, print_line
from uwb_mitigation.commands.support.options import Command, check_output, output_option
from uwb_mitigation.errors import ModelError

app = typer.Typer(help="Build firmware.", no_args_is_help=True)


@app.command(cls=Command)
def export_c(
    output: Annotated[Path, output_option("DIR")], model: Path | None = None, json: JsonOption = None
) -> None:
    """Write a model as a C header for the firmware.

    It contains weights, constants and golden vectors.

    Options:
        output: Folder for uwb_model.h; created if it does not exist.
        model: Int8 bundle. Default: the shipped one.
    """
    from uwb_mitigation.mitigation.embedded.export import GOLDEN_VECTORS, export_bundle
    from uwb_mitigation.mitigation.model.bundle import load_bundle
    from uwb_mitigation.mitigation.model.shipped import model_path
    from uwb_mitigation.types.measurement import RadioType

    bundle = load_bundle(model_path(model))
    if RadioType.DW1000 not in bundle.card.radios:
        trained_for = f"the firmware drives a DW1000, and the model was trained for {bundle.card.source}"
        raise ModelError(trained_for, where=bundle.path, valid="a model for the DW1000")
    header = export_bundle(bundle, output)
    result = {
        "header": str(header),
        "model_id": bundle.model_id,
        "k": bundle.card.architecture.samples,
        "parameters": bundle.card.architecture.parameters,
        "golden_vectors": GOLDEN_VECTORS,
    }
    print_line(f"{header}: model {bundle.model_id:08x}, K = {result['k']}, {result['parameters']} parameters")
    console.write_json(json, result)


@app.command(cls=Command)
def build_image(
    output: Annotated[Path, output_option("FILE.hex")] = Path("dwm1001-dev.hex"),
    model: Path | None = None,
    json: JsonOption = None,
) -> None:
    """Build the DWM1001-DEV image as Intel HEX.

    It contains the ranging firmware with a model that corrects on the board. The board is an anchor unless its host, or
    its button pressed during start-up, makes it a tag. The image has not been run on a board; its driver and
    exchange were tested on a chip model.

    Options:
        output: Image file; copy it to the USB drive of the board.
        model: Int8 bundle. Default: the shipped one.
    """
    import tempfile

    from uwb_mitigation.mitigation.embedded import toolchain
    from uwb_mitigation.mitigation.embedded.export import export_bundle
    from uwb_mitigation.mitigation.model.bundle import load_bundle
    from uwb_mitigation.mitigation.model.shipped import model_path

    check_output(output, suffix="")
    bundle = load_bundle(model_path(model))
    with tempfile.TemporaryDirectory() as folder:
        export_bundle(bundle, Path(folder))
        image = toolchain.compile_image(Path(folder), Path(folder), toolchain.Target.DWM1001_DEV)
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
