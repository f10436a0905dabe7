"""`uwb-mitigation export-c` and `bench firmware`: a model as C, and what it costs on a microcontroller."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.box import SIMPLE_HEAD
from rich.table import Table

from uwb_mitigation.commands import console
from uwb_mitigation.commands.console import JsonOption
from uwb_mitigation.errors import ParameterError

if TYPE_CHECKING:
    from uwb_mitigation.firmware_export.measurement import Row

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
    """Write a model as a C header for the firmware: weights, constants and golden vectors."""
    from uwb_mitigation.firmware_export.export import GOLDEN_VECTORS, export_bundle
    from uwb_mitigation.model.bundle import load_bundle
    from uwb_mitigation.model.shipped import default_model_path

    bundle = load_bundle(model or default_model_path())
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
    """Run the firmware in an emulated Cortex-M4: instructions, memory, and equality with ONNX Runtime.

    Instructions are counted exactly; cycles are estimated for zero wait states. Wait states of flash,
    caches and power are for a board to show.
    """
    from uwb_mitigation.firmware_export import measurement
    from uwb_mitigation.firmware_export.toolchain import Kernels, require_tools
    from uwb_mitigation.model.bundle import load_bundle

    if not 1 <= inputs <= 1_000_000:
        raise ParameterError(f"--inputs {inputs}", valid="1 to 1000000")
    require_tools()
    if model is not None:
        chosen = [measurement.bundle_subject(load_bundle(model))]
    else:
        chosen = list(measurement.subjects())
    rows = []
    with console.progress() as bar:
        task = bar.add_task("emulating", total=len(chosen) * (2 if portable else 1))
        for subject in chosen:
            rows.append(measurement.measure(subject, inputs=inputs))
            bar.advance(task)
            if portable:
                # Ten times slower, and compared with ONNX Runtime on the host as well.
                few = min(inputs, 100)
                rows.append(measurement.measure(subject, kernels=Kernels.PORTABLE, inputs=few))
                bar.advance(task)
    console.out.print(_table(rows))
    console.write_json(json, {"rows": [asdict(row) for row in rows]})


def _table(rows: list[Row]) -> Table:
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
