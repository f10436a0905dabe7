"""`uwb-mitigation field-report`: a guided test of a pair of radios, as a page and a file to send."""

from __future__ import annotations

import getpass
import io
import json
import math
import platform
import re
import socket
import tempfile
import zipfile
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict
from datetime import datetime, timezone
from functools import partial
from itertools import zip_longest
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

import uwb_mitigation
from uwb_mitigation.commands.support import console
from uwb_mitigation.commands.support.console import JsonOption, print_line
from uwb_mitigation.commands.support.options import check_output, option, output_option
from uwb_mitigation.errors import LinkError, ParameterError
from uwb_mitigation.files import write_atomically

if TYPE_CHECKING:
    from uwb_mitigation.commands.field.checks import Check, Observation
    from uwb_mitigation.types.measurement import Truth


def field_report(
    source: Annotated[Literal["uci", "evb1000", "spi", "serial", "lines", "pans"], option()],
    port: Annotated[str, option(metavar="P[,P2]")],
    distance: Annotated[float, option()],
    output: Annotated[Path, output_option("FILE.zip")] = Path("field_report.zip"),
    mapping: Annotated[str, typer.Option("--map", metavar="MAPPING")] = "",
    seconds: Annotated[float, option(min=2.0, max=3600.0)] = 300.0,
    unplug: bool = True,
    force: bool = False,
    json: JsonOption = None,
) -> None:
    """Test a pair of radios at a known distance and write a report.

    Place both radios in line of sight, 2 m to 10 m apart, and stop all drivers. The zip file contains the page
    report.html, the ranges with their CIRs, the release of the kernel and, for uci, lines and pans, the raw bytes and the
    device information of the board. It contains no host name, user name or path. Attach it to an issue of type "Field report".
    The exit code is 1 if a check fails.

        uwb-mitigation field-report --source uci --port /dev/ttyACM0 --distance 3

    Options:
        source: Kind of radio.
        port: Port of the tag, and of an anchor at this computer.
        distance: Distance between the antennas, m.
        output: File to attach to an issue.
        mapping: Mapping for the source lines, as for the driver.
        seconds: Duration of the measurement.
        unplug: Test unplugging and reconnecting the first port.
        force: Replace FILE.zip if it exists.
    """
    if not 0.1 <= distance <= 500.0:
        raise ParameterError(f"--distance {distance}", valid="0.1 to 500 m")
    check_output(output, force, suffix=".zip")
    ports = [name.strip() for name in port.split(",") if name.strip()]
    for name in ports:
        if name.startswith("/") and not Path(name).exists():
            raise LinkError("is not there", where=name, valid="connect the board")
    # NumPy, the drivers and the statistics would delay the messages above.
    from uwb_mitigation.commands.field.checks import Observation, Verdict, run_checks
    from uwb_mitigation.commands.field.test import observe

    observation = Observation(distance, seconds)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        with console.stage_bars() as on_progress:
            capture, unplug_request = folder / "capture.txt", _ask if unplug else None
            advance = partial(on_progress, "ranging")
            observe(source, ports, mapping, observation, capture, unplug_request, advance, console.warn)
        _correct(observation)
        hidden = partial(anonymise, ports=ports)
        observation.problem = hidden(observation.problem)
        observation.warnings = [hidden(text) for text in observation.warnings]
        observation.counters = {name: hidden(str(value)) for name, value in observation.counters.items()}
        observation.identity = {name: hidden(text) for name, text in observation.identity.items()}
        checks = run_checks(observation)
        _write(folder, source, observation, checks)
        write_atomically(output, _packed(folder))
    rows = [(check.name, check.verdict.value, check.value, check.limit) for check in checks]
    console.show_table(
        "Field report", ("check", "result", "value", "limit"), rows, left=4, optional=["limit"]
    )
    for check in checks:
        if check.verdict is not Verdict.PASS and check.remedy:
            console.warn(f"{check.name}: {check.remedy}")
    failed = sum(check.verdict is Verdict.FAIL for check in checks)
    print_line(
        f"{output}: {len(checks)} checks, {failed} failed; read report.html in it, and attach the file to an issue"
    )
    console.write_json(json, {"checks": checks})
    if failed:
        raise typer.Exit(1)


def _ask(port: str) -> None:
    console.warn(f"Unplug the board at {port}, wait 2 s, and plug it in again (60 s).")


def _correct(observation: Observation) -> None:
    """Correct the ranges with the shipped models if one was trained for the radio."""
    from uwb_mitigation.mitigation.correction import Mitigation
    from uwb_mitigation.mitigation.model.choice import CirKind
    from uwb_mitigation.mitigation.model.shipped import load_model

    mitigation = Mitigation(load_model())
    choices = {mitigation.choose(CirKind.of(measured.cir)) for measured in observation.ranges}
    observation.model = "; ".join(sorted(map(str, choices)))
    if observation.has_cirs and all(choice.is_trained for choice in choices):
        observation.corrected = mitigation.correct(observation.ranges)


def _write(folder: Path, source: str, observation: Observation, checks: list[Check]) -> None:
    """Write the page, the values and the ranges."""
    from uwb_mitigation.commands.field.test import SOURCES
    from uwb_mitigation.recordings.bag.writer import BagWriter
    from uwb_mitigation.types.measurement import Record, Truth

    values = {
        "date": f"{datetime.now(timezone.utc):%Y-%m-%d %H:%M} UTC",
        "source": source,
        "distance_m": observation.distance_m,
        "seconds": observation.seconds,
        "ranges": len(observation.ranges),
        "system": {
            "uwb_mitigation": uwb_mitigation.__version__,
            "system": f"{platform.system()} {platform.release()} {platform.machine()}",
            "Python": platform.python_version(),
            **observation.identity,
        },
        "counters": observation.counters,
        "checks": [asdict(check) for check in checks],
    }
    truth = Truth(observation.distance_m, "LOS", "field report")
    title, _ = SOURCES[source]
    (folder / "report.html").write_text(_page(title, observation, truth, checks, values), encoding="utf-8")
    (folder / "report.json").write_text(json.dumps(values, indent=2) + "\n", encoding="utf-8")
    with BagWriter(folder / "ranges.mcap", {"source": "field report", "simulated": "unknown"}) as bag:
        for measured in observation.ranges:
            bag.write(Record(measured, truth))


def _page(
    title: str, observation: Observation, truth: Truth, checks: list[Check], values: dict[str, Any]
) -> str:
    """Return the page: checks, figures of the viewer, properties of the system."""
    from markupsafe import Markup

    from uwb_mitigation.types.measurement import CorrectedBy, CorrectedRange, Status
    from uwb_mitigation.types.ros.codec import measurement_key
    from uwb_mitigation.viewer.charts import HEADINGS
    from uwb_mitigation.viewer.feed import SceneUpdater
    from uwb_mitigation.viewer.report import draw_scene, render_report
    from uwb_mitigation.viewer.scene import Scene
    from uwb_mitigation.viewer.state import View

    feed = SceneUpdater(Scene())
    for measured, corrected in zip_longest(observation.ranges, observation.corrected):
        key, raw_m = measurement_key(measured), measured.range_m
        shown = corrected or CorrectedRange(raw_m, raw_m, 0.0, math.nan, Status.NO_CIR, CorrectedBy.HOST, 0)
        feed.measurement(measured)
        feed.truth(key, truth)
        feed.corrected(key, shown)
    figures, _ = draw_scene(View(feed.scene))
    counts = Counter(check.verdict.value for check in checks)
    severity = ("fail", "warning", "pass")
    lines = [
        f"{counts['fail']} failed, {counts['warning']} warning{'s' * (counts['warning'] != 1)}, {counts['pass']} passed.",
        f"{values['date']}; {values['ranges']} ranges at {observation.distance_m:.2f} m in {observation.seconds:.0f} s.",
        Markup(
            "Please attach the zip file with this page to an issue of type <em>Field report</em>, also if checks failed. The file "
            "contains this page, the ranges with their CIRs, the release of the kernel, and of UCI boards the raw bytes and the "
            "device information. It contains no host name, user name or path."
        ),
    ]
    rows = [
        (check.name, check.verdict.value, check.value, check.limit, check.remedy)
        for check in sorted(checks, key=lambda check: severity.index(check.verdict.value))
    ]
    sections: dict[str, Any] = {"Checks": [("check", "result", "value", "limit", "what to do"), *rows]}
    sections |= {HEADINGS[name]: figures[name] for name in ("strip", "errors", "cir")}
    for heading, name in (("System", "system"), ("Counters of the driver", "counters")):
        sections[heading] = [("name", "value"), *values[name].items()]
    return render_report(f"Field report: {title}", lines, sections)


def _packed(folder: Path) -> bytes:
    """Return the zip file."""
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED) as archive:
        for path in sorted(folder.iterdir()):
            # Without the times and owners of files.
            archive.writestr(zipfile.ZipInfo(path.name), path.read_bytes(), zipfile.ZIP_DEFLATED)
    return content.getvalue()


def anonymise(text: str, ports: Sequence[str] = ()) -> str:
    """Replace ports, paths, host name and user name."""
    for path in sorted((*ports, str(Path.home()), str(Path.cwd())), key=len, reverse=True):
        text = text.replace(path, "PATH") if len(path) > 1 else text
    text = re.sub(r"(?<![\w.<])~?/*(?:/[\w.~+@-]+){2,}[^\s\"'<>,;:)]*", "PATH", text)
    names = [socket.gethostname(), Path.home().name]
    with suppress(Exception):  # a container may have no user
        names.append(getpass.getuser())
    for name in names:
        if len(name) > 1:
            text = re.sub(rf"(?<!\w){re.escape(name)}(?!\w)", "NAME", text)
    return text
