"""Report of `data import --map`: ids, the first converted ranges, errors, and what is missing for a model."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from itertools import islice
from typing import TYPE_CHECKING, Any

import numpy as np

from uwb_mitigation.commands.support import console
from uwb_mitigation.commands.support.console import print_line, show_table
from uwb_mitigation.errors import format_id

if TYPE_CHECKING:
    from uwb_mitigation.recordings.mapping.mapped import MappedRecording

_ROWS, _CHECKED = 5, 1000
_FIELDS = (
    ("range, m", "range", 3),
    ("true range, m", "true range", 3),
    ("receive level, dBm", "rx_power", 1),
    ("first-path level, dBm", "first_path_power", 1),
    ("first-path index", "first_path_index", 2),
    ("preamble count", "preamble_count", 0),
)


def show(sources: Sequence[MappedRecording], *, preview: bool) -> dict[str, Any]:
    """Print dropped rows, warnings and on request the first ranges; return the counts for JSON."""
    dropped = sum((source.dropped for source in sources), Counter[str]())
    warnings = [warning for source in sources for warning in source.warnings]
    for rule, count in dropped.items():
        print_line(f"Dropped {count} rows: {rule}")
    for source in sources:
        for note in source.notes:
            print_line(note)
        if source.names:
            rows = [[name, str(number)] for name, number in source.names.items()]
            show_table("", ("tag or anchor name", "id"), rows)
    for warning in warnings:
        console.warn(f"warning: {warning}")
    for source in sources if preview else ():
        show_preview(source)

    def distinct(name: str) -> int:
        return len(np.unique(np.concatenate([source.values[name] for source in sources])))

    return {
        "ranges": sum(map(len, sources)),
        "with_cir": sum(map(_with_cir, sources)),
        "with_truth": sum(len(source.errors_m) for source in sources),
        "anchors": distinct("anchor"),
        "tags": distinct("tag"),
        "dropped": dict(dropped),
        "notes": [note for source in sources for note in source.notes],
        "warnings": warnings,
    }


def _with_cir(source: MappedRecording) -> int:
    return int(np.count_nonzero(source.values["cir"] >= 0))


def show_preview(source: MappedRecording) -> None:
    """Print the first ranges with units, percentiles of the errors, and what is missing."""
    values = source.values
    shown = range(min(_ROWS, len(source)))
    first = int(values["stamp"][0])
    rows = [
        ["time s", *(f"{(int(values['stamp'][row]) - first) / 1e9:.3f}" for row in shown)],
        *([name, *(format_id(int(values[name][row])) for row in shown)] for name in ("tag", "anchor")),
        *(
            [name, *(f"{values[key][row]:.{n}f}".replace("nan", "-") for row in shown)]
            for name, key, n in _FIELDS
        ),
        ["CIR samples", *(str(len(source.cir(row)) or "-") for row in shown)],
        ["label", *(values["label"][row] or "-" for row in shown)],
        ["placement", *(values["configuration"][row] or "-" for row in shown)],
    ]
    print_line(_extent(source))
    title = f"The first of {len(source)} ranges, from {np.datetime64(first // 1_000_000, 'ms')} UTC"
    show_table(title, ("", *(str(row + 1) for row in shown)), rows)
    if len(errors_m := source.errors_m):
        low, middle, high = np.percentile(errors_m, (1, 50, 99))
        text = f"median {middle:+.2f} m, 1 % below {low:+.2f} m, 1 % above {high:+.2f} m"
        print_line(f"Errors (measured - true) of {len(errors_m)} ranges: {text}")
    for line in [*models_of(source), *missing(source)]:
        print_line(line)


def _extent(source: MappedRecording) -> str:
    """Return the duration and the rates of pairs."""
    values = source.values
    duration_s = int(values["stamp"].max() - values["stamp"].min()) / 1e9
    counts = np.unique(np.stack([values["tag"], values["anchor"]]), axis=1, return_counts=True)[1]
    text = f"{duration_s:.1f} s, {len(counts)} pairs with {counts.min()} to {counts.max()} ranges"
    if duration_s > 0:
        text += f" ({counts.min() / duration_s:.2g} to {counts.max() / duration_s:.2g} Hz)"
    return text


def models_of(source: MappedRecording) -> list[str]:
    """Return which shipped model corrects each kind of CIR, or why none does; assumed: the mapping has no `radio`."""
    from uwb_mitigation.mitigation.model.choice import CirKind, choose_model
    from uwb_mitigation.mitigation.model.shipped import load_model

    cirs = [record.measurement.cir for record in islice(source, _CHECKED)]
    kinds = Counter(CirKind.of(cir) for cir in cirs if len(cir))
    models = load_model() if kinds else ()
    texts = [
        f"{n} of the first {len(cirs)} ranges: {choose_model(models, kind)}" for kind, n in kinds.items()
    ]
    return [text.replace("(assumed)", "(assumed: set `radio`)") for text in texts]


def missing(source: MappedRecording) -> list[str]:
    """Return what a model or command will be missing, and the reason."""
    count, with_cir = len(source), _with_cir(source)

    def unknown(name: str) -> bool:
        return not np.isfinite(source.values[name]).any()

    no_cir = f"{count - with_cir} of {count} ranges have no CIR"
    cases = (
        (
            with_cir < count,
            f"{no_cir}: only constants and linear models correct them (networks: status NO_CIR)",
        ),
        (with_cir and unknown("first_path_index"), "no first-path index: networks need it (status BAD_CIR)"),
        (unknown("rx_power"), "no receive level: no linear model"),
        (unknown("first_path_power"), "no first-path level: no linear model of the power gap"),
        (not len(source.errors_m), "no true range: `evaluate`, `train` and `offset` cannot use it"),
        (
            len(source.errors_m) and len(set(source.values["configuration"].tolist())) < 3,
            "fewer than 3 placements (truth.configuration): `train` cannot hold any out",
        ),
        (
            not hasattr(source, "anchors"),
            "no positions of the anchors: `track` and `calibrate` need --anchors",
        ),
    )
    return [text for applies, text in cases if applies]
