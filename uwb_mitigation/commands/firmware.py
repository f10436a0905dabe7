"""`uwb-mitigation board export-c` and `build-image`: a model as C, and the image of a board."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from uwb_mitigation.commands import console
from uwb_mitigation.commands.console import JsonOption
from uwb_mitigation.errors import ParameterError

ModelOption = Annotated[
    Path | None, typer.Option(help="Int8 bundle; the shipped one if left out.", show_default=False)
]


def export_c(
    output: Annotated[
        Path, typer.Option("-o", "--output", metavar="DIR", help="Folder for uwb_model.h; made if need be.")
    ],
    model: ModelOption = None,
    json: JsonOption = None,
) -> None:
    """Write a model as a C header for the firmware.

    It holds weights, constants and golden vectors.
    """
    from uwb_mitigation.firmware_export.export import GOLDEN_VECTORS, export_bundle
    from uwb_mitigation.model.bundle import load_bundle
    from uwb_mitigation.model.shipped import model_path

    bundle = load_bundle(model_path(model))
    header = export_bundle(bundle, output)
    console.out.print(
        f"{header}: model {bundle.model_id:08x}, K = {bundle.architecture.samples}, "
        f"{bundle.architecture.parameters} parameters, {GOLDEN_VECTORS} golden vectors",
        soft_wrap=True,
    )
    console.write_json(
        json,
        {
            "header": str(header),
            "model_id": bundle.model_id,
            "k": bundle.architecture.samples,
            "parameters": bundle.architecture.parameters,
            "golden_vectors": GOLDEN_VECTORS,
        },
    )


def build_image(
    output: Annotated[
        Path, typer.Option("-o", "--output", metavar="FILE.hex", help="Drag it onto the board's drive.")
    ] = Path("dwm1001-dev.hex"),
    model: ModelOption = None,
    json: JsonOption = None,
) -> None:
    """Build the DWM1001-DEV's image, as Intel HEX.

    Ranging firmware with a model for corrections on the board. One image: the board is an anchor until its host, or its
    button held at the start, makes it a tag. It was never run on a board; its driver and exchange
    were tested on a modelled chip.
    """
    import tempfile

    from uwb_mitigation.firmware_export import toolchain
    from uwb_mitigation.firmware_export.export import export_bundle
    from uwb_mitigation.model.bundle import load_bundle
    from uwb_mitigation.model.shipped import model_path

    if not output.absolute().parent.is_dir():
        raise ParameterError(f"--output {output}", valid="a file in a folder that is there")
    bundle = load_bundle(model_path(model))
    with tempfile.TemporaryDirectory() as folder:
        export_bundle(bundle, Path(folder))
        image = toolchain.build_image(Path(folder), Path(folder), toolchain.Target.DWM1001_DEV)
        toolchain.write_hex(image, output)
    console.out.print(
        f"{output}: {image.flash_bytes:,} of {image.flash_room:,} bytes of flash, {image.static_bytes:,} of "
        f"{image.ram_room:,} of RAM, the rest the stack's; model {bundle.model_id:08x}",
        soft_wrap=True,
    )
    console.write_json(
        json,
        {
            "image": str(output),
            "flash_bytes": image.flash_bytes,
            "flash_room": image.flash_room,
            "ram_bytes": image.static_bytes,
            "ram_room": image.ram_room,
            "model_id": bundle.model_id,
        },
    )
