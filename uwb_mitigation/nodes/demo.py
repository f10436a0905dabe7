"""`make demo`: a recording through `driver` and `mitigator`, two processes over real DDS, watched live.

python -m uwb_mitigation.nodes.demo [--recording PATH] [--rate FACTOR]
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import rclpy
import typer
from rclpy.signals import SignalHandlerOptions
from rich.console import Console
from rich.live import Live

from uwb_mitigation.errors import UwbMitigationError
from uwb_mitigation.nodes import topics
from uwb_mitigation.nodes.monitor import REFRESH_HZ, Monitor, live_table, summary
from uwb_mitigation.nodes.running import spin
from uwb_mitigation.sources.simulated import SimulatedSource

SIMULATED_EXCHANGES = 600
SIMULATED_RATE_HZ = 40.0
LONGEST_PAUSE_S = 5.0
TARGET_S = 15.0
CONNECT_TIMEOUT_S = 30.0
SETTLE_S = 3.0


@dataclass(frozen=True, slots=True)
class Programme:
    """What is to be played: the driver's parameters, and what a person should know of it."""

    title: str
    parameters: tuple[str, ...]


def simulated(rate: float) -> Programme:
    """The simulator's default scene; what is too weak to be received gives no range, as on the air."""
    source = SimulatedSource(count=SIMULATED_EXCHANGES, rate_hz=SIMULATED_RATE_HZ)
    return Programme(
        f"simulated recording, {len(list(source))} ranges",
        (
            "source:=simulated",
            f"count:={SIMULATED_EXCHANGES}",
            f"simulated_rate:={SIMULATED_RATE_HZ}",
            f"rate:={rate or 1.0}",
        ),
    )


def recorded(path: Path, rate: float) -> Programme:
    """Read the recording once, so that it fits into about a quarter of a minute unless told otherwise."""
    from uwb_mitigation.sources.mcap import McapRecording
    from uwb_mitigation.sources.opening import open_recording

    count, length_s, last_ns = 0, 0.0, None
    with open_recording(path) as source:
        for record in source:
            stamp_ns = record.measurement.stamp_ns
            if last_ns is not None:
                length_s += min((stamp_ns - last_ns) / 1e9, LONGEST_PAUSE_S)
            count, last_ns = count + 1, stamp_ns
        name = source.name
        kind = "mcap" if isinstance(source, McapRecording) else "decaranging"
    if not count:
        raise UwbMitigationError("the recording holds no range", where=str(path))
    rate = rate or max(1.0, length_s / TARGET_S)
    return Programme(
        f"{name}, {count} ranges, {rate:.1f} x recorded speed",
        (f"source:={kind}", f"path:={path.resolve()}", f"rate:={rate}", f"longest_pause:={LONGEST_PAUSE_S}"),
    )


def start(node: str, *parameters: str) -> subprocess.Popen[bytes]:
    """Start a node as a process of its own."""
    command = [sys.executable, "-c", f"from uwb_mitigation.nodes.{node} import main; main()"]
    arguments = [word for parameter in parameters for word in ("-p", parameter)]
    # A session of its own: Ctrl-C reaches this process, which ends the nodes in order.
    return subprocess.Popen(
        [*command, "--ros-args", "--log-level", "warn", *arguments], start_new_session=True
    )


def stop(*processes: subprocess.Popen[bytes]) -> list[int]:
    """End nodes as Ctrl-C would, and return their exit codes; kill only what does not end.

    Another Ctrl-C must not leave one of them behind, so it is not listened to any more.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    for process in processes:
        if process.poll() is None:
            process.send_signal(signal.SIGINT)
    return [_exit_code(process) for process in processes]


def _exit_code(process: subprocess.Popen[bytes]) -> int:
    try:
        return process.wait(timeout=10)
    except subprocess.TimeoutExpired:
        process.kill()
        return process.wait()


def watch(programme: Programme, console: Console) -> int:
    """Run the nodes and show what they say. Returns the exit code."""
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    monitor = Monitor()
    seen = threading.Event()
    thread = threading.Thread(target=spin, args=(monitor, seen), daemon=True)
    thread.start()
    mitigator = start("mitigator")
    driver: subprocess.Popen[bytes] | None = None
    try:
        wait_for_mitigator(monitor, mitigator)
        # Both the mitigator and this process are to receive the first range too.
        driver = start("driver", *programme.parameters, "wait_for_subscribers:=2", "start_delay:=1.0")
        with Live(console=console, refresh_per_second=REFRESH_HZ) as live:
            while driver.poll() is None and mitigator.poll() is None:
                live.update(live_table(monitor.tally, programme.title))
                time.sleep(1 / REFRESH_HZ)
            # What the mitigator has in hand still arrives after the driver is gone.
            settled = time.monotonic() + SETTLE_S
            while monitor.tally.missing and time.monotonic() < settled:
                time.sleep(0.05)
            live.update(live_table(monitor.tally, programme.title))
    finally:
        codes = stop(mitigator, *([driver] if driver is not None else []))
        seen.set()
        thread.join()
        monitor.destroy_node()
        rclpy.try_shutdown()
    console.print(summary(monitor.tally))
    names = ("mitigator", "driver")
    failed = [f"{name} ended with exit code {code}" for name, code in zip(names, codes, strict=False) if code]
    if monitor.tally.missing or not monitor.tally.corrected:
        failed.append(f"{monitor.tally.corrected} of {monitor.tally.raw} ranges came back corrected")
    for failure in failed:
        console.print(failure, style="red")
    return 1 if failed else 0


def wait_for_mitigator(monitor: Monitor, mitigator: subprocess.Popen[bytes]) -> None:
    """Wait until the mitigator is connected both ways.

    Raises:
        UwbMitigationError: it ended, or did not come up in time.
    """
    deadline = time.monotonic() + CONNECT_TIMEOUT_S
    raw, corrected = (monitor.resolve_topic_name(name) for name in (topics.RANGE_RAW, topics.RANGE_CORRECTED))
    while not (monitor.count_publishers(corrected) and monitor.count_subscribers(raw) >= 2):
        if mitigator.poll() is not None or time.monotonic() > deadline:
            raise UwbMitigationError("the mitigator did not come up", valid="see its message above")
        time.sleep(0.05)


def demo(
    recording: Annotated[
        Path | None,
        typer.Option(help="DecaRanging log, folder of logs, or MCAP bag. Default: a simulated recording."),
    ] = None,
    rate: Annotated[
        float, typer.Option(min=0.0, max=10_000.0, help="Speed of the replay; 0 = about 15 s in all.")
    ] = 0.0,
) -> None:
    """Replay a recording through driver and mitigator, show it live, and sum it up."""
    # A domain of its own, on this machine only, so that the demo meets no robot and no second demo.
    os.environ.setdefault("ROS_DOMAIN_ID", str(1 + os.getpid() % 100))
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    console = Console()
    try:
        programme = simulated(rate) if recording is None else recorded(recording, rate)
        code = watch(programme, console)
    except UwbMitigationError as error:
        console.print(f"demo: {error}", style="red", markup=False)
        code = 1
    except KeyboardInterrupt:
        code = 130
    raise typer.Exit(code)


if __name__ == "__main__":
    typer.run(demo)
