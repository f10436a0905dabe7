"""`uwb-mitigation export-c`, `build-image` and `bench firmware`: a model as C, boards' images, and what they cost."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.box import SIMPLE_HEAD

from uwb_mitigation.commands import console
from uwb_mitigation.commands.console import JsonOption, Table
from uwb_mitigation.errors import ParameterError

if TYPE_CHECKING:
    from uwb_mitigation.benches.firmware_cost import NetworkCost

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
    button held at the start, makes it a tag. Built and emulated only: it was never run on a board.
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


def bench_firmware(
    model: Annotated[
        Path | None, typer.Option(help="Measure this int8 bundle only.", show_default=False)
    ] = None,
    inputs: Annotated[int, typer.Option(help="Windows compared with ONNX Runtime, for each network.")] = 5000,
    portable: Annotated[
        bool, typer.Option("--portable/--no-portable", help="Also the portable C, on fewer windows.")
    ] = True,
    json: JsonOption = None,
) -> None:
    """The firmware in an emulated Cortex-M4: cost, equality.

    Instructions, memory, and whether its results equal ONNX Runtime's to the bit.

    Instructions are counted exactly; cycles are estimated for zero wait states. Wait states of flash,
    caches and power are for a board to show.
    """
    from uwb_mitigation.benches import firmware_cost as bench
    from uwb_mitigation.firmware_export.toolchain import Kernels, require_tools
    from uwb_mitigation.model.bundle import load_bundle

    if not 1 <= inputs <= 1_000_000:
        raise ParameterError(f"--inputs {inputs}", valid="1 to 1000000")
    require_tools()
    chosen = list(bench.random_shapes()) if model is None else [bench.trained(load_bundle(model))]
    rows = []
    with console.progress() as bar:
        task = bar.add_task("emulating", total=len(chosen) * (2 if portable else 1))
        for network in chosen:
            rows.append(bench.measure(network, inputs=inputs))
            bar.advance(task)
            if portable:
                # Ten times slower, and compared with ONNX Runtime on the host as well.
                few = min(inputs, 100)
                rows.append(bench.measure(network, kernels=Kernels.PORTABLE, inputs=few))
                bar.advance(task)
    console.out.print(_table(rows))
    console.write_json(json, {"rows": [asdict(row) for row in rows]})


def _table(rows: list[NetworkCost]) -> Table:
    table = Table(
        title=f"Firmware on an emulated Cortex-M4: {rows[0].inputs} windows each, at most 100 in portable C",
        caption="code: assembly or portable C; Hz at 64 MHz, zero wait states; mJ at the paper's power; "
        "RAM: the arena; wrong: outputs that differ from ONNX Runtime's",
        # Without lines between columns it fits a terminal of 80.
        box=SIMPLE_HEAD,
        padding=0,
    )
    columns = ("model", "K", "k0", "code", "instr.", "cycles", "Hz", "paper", "mJ", "RAM", "flash", "wrong")
    for name in columns:
        table.add_column(name, justify="left" if name in ("model", "code") else "right", no_wrap=True)
    for row in rows:
        table.add_row(
            row.model,
            str(row.k),
            str(row.k0) if row.k0 else "",
            "asm" if row.kernels == "cortex_m4" else "C",
            f"{row.instructions:,}",
            f"{row.cycles_estimated:,}",
            f"{row.hz:.0f}",
            "" if row.paper_hz is None else f"{row.paper_hz:g}",
            "" if row.energy_mj is None else f"{row.energy_mj:.2f}",
            f"{row.ram_bytes:,}",
            f"{row.flash_bytes:,}",
            str(row.mismatches),
        )
    return table
