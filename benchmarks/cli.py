"""Measure nodes, positions, radios, firmware and links: `python -m benchmarks NAME [--json FILE]`, in a checkout.

More commands: emulated boards (`emulate-board`, `emulate-evb1000`, `emulate-lines`, `emulate-uci`), three demonstrations (`demo`,
`radio-demo`, `firmware-demo`), and the experiment of the paper (`paper`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from benchmarks.equipment.emulate_board import emulate_board
from benchmarks.equipment.emulate_evb1000 import emulate_evb1000
from benchmarks.equipment.emulate_lines import emulate_lines
from benchmarks.equipment.emulate_uci import emulate_uci
from benchmarks.paper import cli as paper
from uwb_mitigation.commands import cli
from uwb_mitigation.commands.support import console
from uwb_mitigation.commands.support.console import ConsoleTable, JsonOption
from uwb_mitigation.errors import ParameterError

if TYPE_CHECKING:
    from benchmarks.nodes import SubjectResult

app = typer.Typer(
    name="python -m benchmarks",
    help="Measure what the parts of the system can do.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    add_completion=False,
)
app.command("emulate-board")(emulate_board)
app.command("emulate-evb1000")(emulate_evb1000)
app.command("emulate-lines")(emulate_lines)
app.command("emulate-uci")(emulate_uci)
app.add_typer(paper.app, name="paper")


@app.command()
def nodes(
    repeats: Annotated[
        int, typer.Option(min=1, help="Searches for the highest rate; the median counts.")
    ] = 3,
    slices: Annotated[int, typer.Option(min=1, help="Slices for each latency; the median counts.")] = 5,
    seconds: Annotated[float, typer.Option(min=0.5, help="Duration of a slice.")] = 2.0,
    viewer: Annotated[
        bool, typer.Option("--viewer", help="Measure the load of the viewer with 0, 1 and 10 pages instead.")
    ] = False,
    json: JsonOption = None,
) -> None:
    """Rate and latency of relay, mitigator and one-process pipeline.

    The subjects run in turns with the same ranges. One run takes about five minutes.
    """
    from benchmarks import nodes as bench
    from benchmarks import viewer as viewer_bench

    with console.progress() as bar:
        task = bar.add_task("starting the nodes", total=1.0)

        def advance(text: str, share: float) -> None:
            bar.update(task, description=text, completed=share)

        if viewer:
            costs = viewer_bench.measure(repeats, 5.0 * seconds, advance)
            result: dict[str, Any] = asdict(costs) | {"rate_ratios": costs.rate_ratios}
        else:
            result = nodes_result(bench.measure(repeats, slices, seconds, advance))
    _report(result, json)


@app.command()
def soak(
    messages: Annotated[
        int, typer.Option(min=1000, help="Number of ranges; the default is 8 h at 40 Hz.")
    ] = (1_152_000),
    rate: Annotated[float, typer.Option(min=1.0, max=20_000.0, help="Ranges per second.")] = 2000.0,
    one_process: Annotated[
        bool, typer.Option("--one-process", help="Use the pipeline instead of two nodes.")
    ] = False,
    json: JsonOption = None,
) -> None:
    """Long run of the nodes: memory, file descriptors and threads."""
    from benchmarks import nodes as bench

    with console.progress() as bar:
        task = bar.add_task("ranges corrected", total=messages)
        outcome = bench.soak(
            messages, rate, one_process=one_process, advance=lambda done: bar.update(task, completed=done)
        )
    _report(asdict(outcome), json)


@app.command()
def locator(
    rate: Annotated[float, typer.Option(min=1.0, max=5000.0, help="Ranges per second to the node.")] = 1000.0,
    seconds: Annotated[float, typer.Option(min=1.0, help="Duration of the stream.")] = 20.0,
    json: JsonOption = None,
) -> None:
    """Locator: time of the filter, latency and loss of the node. `positions` measures errors."""
    from benchmarks import locator as cost

    with console.progress() as bar:
        task = bar.add_task("filter", total=None)
        us_per_range = cost.filter_us()
        node = cost.node(rate, seconds, lambda text: bar.update(task, description=text))
    result: dict[str, Any] = {
        "us_per_range": us_per_range,
        "node_p50_ms": node.p50_ms if math.isfinite(node.p50_ms) else None,
        "node_p99_ms": node.p99_ms if math.isfinite(node.p99_ms) else None,
        "lost": node.lost,
        "sent": node.sent,
    }
    _report(result, json)


@app.command()
def positions(
    data: Annotated[
        Path | None,
        typer.Option(
            help="Folder with a folder for each data set, named like a shipped mapping (hanyang, labyrinth, rcv); "
            "default: simulated drives only."
        ),
    ] = None,
    simulated: Annotated[bool, typer.Option(help="Also evaluate simulated drives.")] = True,
    calibrate: Annotated[
        bool, typer.Option(help="Also calibrate each run on another one; this takes most of the time.")
    ] = True,
    json: JsonOption = None,
) -> None:
    """Position errors from raw, corrected and calibrated ranges, next to simple filters."""
    from benchmarks import positions as bench

    if data is not None and not data.is_dir():
        raise ParameterError("no such folder", where=str(data), valid="a folder of data sets")
    with console.progress() as bar:
        task = bar.add_task("reading", total=1.0)
        result = bench.measure(
            data,
            calibrate=calibrate,
            simulated=simulated,
            advance=lambda text, share: bar.update(task, description=text, completed=share),
        )
    _show_positions(result)
    console.write_json(json, result)


@app.command()
def serial(
    rate: Annotated[
        float, typer.Option(min=1.0, max=10_000.0, help="Ranges per second of the board.")
    ] = 1000.0,
    seconds: Annotated[float, typer.Option(min=1.0, max=1e6, help="Duration of the steady stream.")] = 60.0,
    unplugs: Annotated[int, typer.Option(min=1, max=1_000_000, help="Number of unplugged cables.")] = 50,
    json: JsonOption = None,
) -> None:
    """Driver with an emulated board on a serial link: loss, latency, reconnection."""
    from benchmarks import serial_link as bench

    with console.progress() as bar:
        task = bar.add_task("streaming", total=None)
        steady = bench.steady(rate, seconds)
        bar.update(task, description="unplugging")
        unplug = bench.unplug(unplugs)
    _report({"steady": asdict(steady), "unplug": asdict(unplug)}, json)


@app.command()
def link(
    frames: Annotated[int, typer.Option(min=1, help="Number of frames.")] = 200_000,
    damage: Annotated[float, typer.Option(help="Share of bytes flipped, dropped, inserted, each.")] = 1e-4,
    seed: Annotated[int, typer.Option(min=0, help="Seed of payloads and damage.")] = 0,
    json: JsonOption = None,
) -> None:
    """Decoder with a channel that corrupts bytes: lost frames, speed."""
    from benchmarks.decoder import loopback
    from benchmarks.equipment.faults import Faults

    faults = Faults(damage, damage, damage)
    with console.stage_bars() as on_progress:
        done = loopback(
            frames, faults, seed=seed, advance=lambda count: on_progress("sending", count / frames)
        )
    result = asdict(done) | {"decoder_mb_per_s": done.decoder_mb_per_s}
    _report({key: value for key, value in result.items() if key not in ("bytes_received", "decoder_s")}, json)


@app.command()
def radio(
    seconds: Annotated[
        float, typer.Option(min=0.5, max=60.0, help="Virtual time for each distance and pair of clocks.")
    ] = 3.0,
    exchanges: Annotated[int, typer.Option(min=0, max=10_000_000, help="Exchanges of the soak; 0: skip.")] = (
        200_000
    ),
    evb1000: Annotated[
        float, typer.Option(min=0.0, max=600.0, help="Seconds of two emulated EVB1000s; 0: skip.")
    ] = 10.0,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the soak.")] = 1,
    json: JsonOption = None,
) -> None:
    """Ranging of the firmware on modelled radios: error, rates, soak.

    The chips are modelled register by register, in virtual time. The emulated EVB1000s answer in wall-clock time: a
    busy computer slows them down. No result was measured on a real board.
    """
    from benchmarks import radio as bench
    from uwb_mitigation.radios.wire.layout import Mode

    with console.progress() as bar:
        task = bar.add_task("ranging", total=len(bench.PPM_PAIRS) * len(bench.DISTANCES_M))
        rows = bench.ranging(seconds, lambda: bar.advance(task))
        host_hz, device_hz = bench.serial_rate_hz(Mode.HOST), bench.serial_rate_hz(Mode.DEVICE)
        evb1000_hz = None
        if evb1000:
            task = bar.add_task("EVB1000s", total=None)
            evb1000_hz = bench.evb1000_rate_hz(evb1000)
        soaked = None
        if exchanges:
            task = bar.add_task("soak", total=exchanges)
            soaked = asdict(bench.soak(exchanges, seed, lambda done: bar.update(task, completed=done)))
    _report(
        {
            "ranging": [asdict(row) for row in rows],
            "host_rate_hz": host_hz,
            "device_rate_hz": device_hz,
            "evb1000_rate_hz": evb1000_hz,
            "soak": soaked,
        },
        json,
    )


@app.command()
def uci(
    exchanges: Annotated[
        int, typer.Option(min=0, max=10_000_000, help="Exchanges on the damaged stream; 0: skip.")
    ] = (100_000),
    seconds: Annotated[float, typer.Option(min=1.0, max=600.0, help="Duration of each rate.")] = 10.0,
    unplugs: Annotated[int, typer.Option(min=1, max=1000, help="Number of unplugged cables.")] = 10,
    seed: Annotated[int, typer.Option(min=0, help="Seed of losses and damage.")] = 1,
    json: JsonOption = None,
) -> None:
    """Emulated UCI boards: rates, joins with 5 % lost notifications and 1 % damaged bytes, recovery.

    The rates are those of two boards on pseudo-terminals in wall-clock time. No result was measured on a real board.
    """
    from benchmarks import uci as bench

    result: dict[str, Any] = {f"rate_{taps}_taps_hz": bench.rate_hz(taps, seconds) for taps in (16, 157)}
    recoveries_s = bench.recoveries_s(unplugs)
    result |= {"unplugs": unplugs, "longest_recovery_s": max(recoveries_s)}
    if exchanges:
        with console.stage_bars() as on_progress:
            advance = partial(on_progress, "exchanges")
            result |= asdict(bench.joins(exchanges, 16, 0.05, 0.01, seed, advance))
            lossy = bench.joins(exchanges // 10, 157, 0.05, 0.0, seed, advance)
        result |= {"lossy_157_taps": asdict(lossy)}
    _report(result, json)


@app.command()
def firmware(
    model: Annotated[
        Path | None, typer.Option(help="Measure only this int8 bundle.", show_default=False)
    ] = None,
    inputs: Annotated[
        int, typer.Option(min=1, max=1_000_000, help="Windows per network to compare with ONNX Runtime.")
    ] = 5000,
    portable: Annotated[
        bool, typer.Option("--portable/--no-portable", help="Also the portable C, on fewer windows.")
    ] = True,
    json: JsonOption = None,
) -> None:
    """The firmware in an emulated Cortex-M4: cost, equality with ONNX Runtime.

    Instructions are counted exactly; cycles are estimated for zero wait states. The effect of wait
    states and caches, and the power, can only be measured on a board.
    """
    from benchmarks import firmware as bench
    from uwb_mitigation.mitigation.embedded.toolchain import Kernels, require_tools
    from uwb_mitigation.mitigation.model.bundle import load_bundle

    require_tools()
    networks = list(bench.random_shapes()) if model is None else [bench.trained(load_bundle(model))]
    rows = []
    with console.step_bar("emulating", len(networks)) as advance:
        for network in networks:
            rows.append(bench.measure(network, inputs=inputs))
            if portable:
                # Ten times slower, and also compared with ONNX Runtime on the host.
                rows.append(bench.measure(network, kernels=Kernels.PORTABLE, inputs=min(inputs, 100)))
            advance()
    _report({"rows": [asdict(row) for row in rows]}, json)


@app.command()
def demo(
    recording: Annotated[
        Path | None,
        typer.Option(help="DecaRanging log, folder of logs, or MCAP bag. Default: a simulated recording."),
    ] = None,
    rate: Annotated[
        float,
        typer.Option(min=0.0, max=10_000.0, help="Speed of the replay; 0: total duration of about 15 s."),
    ] = 0.0,
) -> None:
    """Replay a recording through driver and mitigator, show it live, and print a summary."""
    from benchmarks import demo as shown

    raise typer.Exit(shown.main(recording, rate))


@app.command("radio-demo")
def radio_demo(
    seconds: Annotated[
        float, typer.Option(min=0.0, max=3600.0, help="Duration of ranging after each anchor has answered.")
    ] = 15.0,
) -> None:
    """A tag ranges with four anchors on modelled chips, through driver and mitigator."""
    from benchmarks import radio_demo as demo

    raise typer.Exit(demo.main(seconds))


@app.command("firmware-demo")
def firmware_demo(
    recording: Annotated[
        Path | None,
        typer.Option(help="DecaRanging log, folder of logs, or MCAP bag. Default: a simulated recording."),
    ] = None,
    count: Annotated[int, typer.Option(min=1, max=100_000, help="Maximum number of ranges.")] = 200,
) -> None:
    """Run the firmware in an emulator as a board of the driver, and compare its ranges with the host's."""
    from benchmarks import firmware_demo as demo

    raise typer.Exit(demo.main(recording, count))


def nodes_result(figures: Mapping[str, SubjectResult]) -> dict[str, Any]:
    """Return figures by subject as plain values, with the ratios between the subjects under `ratios`."""
    from benchmarks.nodes import rate_ratio

    result: dict[str, Any] = {}
    for name, of in figures.items():
        values = asdict(of)
        values["latency_us"] = {str(rate): latency for rate, latency in values["latency_us"].items()}
        result[name] = {"max_lossless_rate_hz": of.max_lossless_rate_hz} | values
    relay, mitigator, pipeline = (figures[name] for name in ("relay", "mitigator", "pipeline"))
    result["ratios"] = {
        "mitigator_rate_over_relay": rate_ratio(mitigator.max_lossless_rate_hz, relay.max_lossless_rate_hz),
        "pipeline_rate_over_mitigator": rate_ratio(
            pipeline.max_lossless_rate_hz, mitigator.max_lossless_rate_hz
        ),
        "added_p99_us_at_500_hz": mitigator.latency_us[500].p99 - relay.latency_us[500].p99,
    }
    return result


_COLUMNS = 4


def _report(result: Mapping[str, Any], json: Path | None) -> None:
    """Print a table for each list of rows, and one for all other values; write the JSON file."""
    scalars = ConsoleTable("figure", "value", title_justify="left")
    for key, value in result.items():
        if isinstance(value, list | tuple) and value:
            rows = [_flat(row) for row in value]
            for start in range(0, len(rows), _COLUMNS):
                # One column for each row, since a terminal has no space for all figures next to each other.
                shown = rows[start : start + _COLUMNS]
                table = ConsoleTable(
                    key, *(str(number) for number in range(start + 1, start + 1 + len(shown)))
                )
                for name in rows[0]:
                    table.add_row(name, *(_text(row.get(name, "")) for row in shown))
                console.out.print(table)
        else:
            for name, figure in _flat({key: value}).items():
                scalars.add_row(name, _text(figure))
    if scalars.row_count:
        console.out.print(scalars)
    console.write_json(json, result)


_RUN_TABLES = {
    "Horizontal RMSE, m": {
        "least squares": "raw_least_squares:.3f",
        "EKF": "raw_ekf:.3f",
        "EKF offset": "raw_ekf_offset:.3f",
        "locator": "raw_locator:.3f",
        "ratio": "ratio_to_best_baseline:.2f",
        "NEES": "nees_per_dof:.2f",
        "in 95 %": "coverage95:.0%",
    },
    "Horizontal RMSE of the locator with other inputs, m": {
        "corrected": "corrected_locator:.3f",
        "calibrated": "calibrated_locator:.3f",
        "odometry": "odometry_locator:.3f",
        "both": "corrected_odometry_locator:.3f",
        "smoothed": "smoothed:.3f",
    },
}
_SET_TABLES = {
    "Mean ratios of the locator's RMSE to that of the best simple filter, and of other inputs to raw ranges": {
        "runs": "runs:d",
        "simple": "ratio_mean:.2f",
        "corrected": "corrected_to_raw_mean:.2f",
        "calibrated": "calibrated_to_raw_mean:.2f",
        "odometry": "odometry_to_raw_mean:.2f",
    },
    "Largest ratios (faults: of odometry)": {
        "simple": "ratio_max:.2f",
        "corrected": "corrected_to_raw_max:.2f",
        "calibrated": "calibrated_to_raw_max:.2f",
        "faults": "odometry_fault_ratio_max:.2f",
    },
    "Consistency with raw ranges": {
        "NEES min": "nees_per_dof_min:.2f",
        "NEES max": "nees_per_dof_max:.2f",
        "in 95 % min": "coverage95_min:.0%",
        "in 95 % max": "coverage95_max:.0%",
    },
    "Smallest share of published positions, largest shares beyond the protection levels": {
        "published": "published_min:.0%",
        "beyond": "protection_exceeded_max:.2%",
        "height beyond": "height_exceeded_max:.2%",
    },
    "Headings: shares that are published, and that are wrong": {
        "mean": "heading_published_mean:.0%",
        "min": "heading_published_min:.0%",
        "wrong, max": "heading_wrong_max:.2%",
    },
}
"""Tables of `positions` with a line for each run or set, for a terminal of 80 columns."""


def _show_positions(result: Mapping[str, Any]) -> None:
    """Print the errors of each run, and the summary of each set."""
    runs = []
    for entry in result["sets"]:
        rows, name = entry["rows"], f"{entry['name']} {entry['run']}"
        figures = {row: scores["rmse_m"] for row, scores in rows.items()}
        runs.append(entry | rows.get("raw_locator", {}) | figures | {"name": name})
    summary = result["summary"]
    sets = [{"name": name, **figures} for name, figures in summary["by_set"].items()]
    _show_tables("run", _RUN_TABLES, runs)
    _show_tables("set", _SET_TABLES, [*sets, {**summary, "name": "all"}])
    console.print_line(
        f"Largest share beyond the protection levels in ambiguous drives: {_text(summary['ambiguous_protection_exceeded'])}"
    )
    for entry in result["sets"]:
        for row, reason in entry["failed"].items():
            console.warn(f"{entry['name']} {entry['run']}: no {row}: {reason}")
    for entry in result["skipped"]:
        console.warn(f"skipped {entry['path']}: {entry['reason']}")


def _show_tables(kind: str, tables: Mapping[str, Mapping[str, str]], rows: list[dict[str, Any]]) -> None:
    """Print tables without the rows that have no figure in them."""
    for title, columns in tables.items():
        keys = [column.partition(":")[0] for column in columns.values()]
        present = [row for row in rows if any(row.get(key) is not None for key in keys if key != "runs")]
        shown = {kind: "name", **columns}
        console.show_table(title, shown, present, max_rows=len(present), optional=[*columns])


def _flat(value: Any, prefix: str = "") -> dict[str, Any]:
    """Return the leaves of nested mappings, {path with dots: value}."""
    if not isinstance(value, Mapping):
        return {prefix: value}
    start = f"{prefix}." if prefix else ""
    return {path: leaf for key, of in value.items() for path, leaf in _flat(of, f"{start}{key}").items()}


def _text(value: Any) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def main() -> None:
    """Run the command line."""
    cli.run(app, "benchmarks")
