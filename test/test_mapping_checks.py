"""What mapped recordings report: wrong anchors, units, stamps, CIRs; and wide tables, placements."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from command_line import succeed
from scipy.io import savemat
from test_mapping import PLAIN, of, ranges_of, read, values_of, with_fields, write

from uwb_mitigation.errors import RecordingError
from uwb_mitigation.recordings.formats import open_mapped
from uwb_mitigation.recordings.mapping.mapping import load_mapping

MARKERS = {6: 12, 9: 9, 10: 11, 11: 7, 12: 4, 13: 10, 15: 5, 16: 6}
"""Radio next to each marker of STAR-loc's sessions 1 and 2."""


def starloc(folder: Path, swapped: bool = False) -> Path:
    positions = {marker: np.array([3.0 * n, 5.0 - 2 * n, n / 2]) for n, marker in enumerate(MARKERS)}
    rows = "".join(f"{marker},{x},{y},{z}\n" for marker, (x, y, z) in positions.items())
    write(folder / "mocap/uwb_markers_v1.csv", f",x,y,z\n{rows}")
    lines = ["time_s,to_id,range,from_id,tag_pos_x,tag_pos_y,tag_pos_z,gt_range"]
    for n in range(400):
        marker, tag = list(MARKERS)[n % 8], np.array([n / 100, 1.0, 1.0])
        distance = np.linalg.norm(positions[marker] - tag)
        first, second = (1, MARKERS[marker]) if swapped else (MARKERS[marker], 1)
        lines.append(f"{n / 50},{first},{distance + 0.1},{second},{tag[0]},1,1,{distance}")
    write(folder / "data/loop-2d_s1/uwb.csv", "\n".join(lines))
    return folder / "data/loop-2d_s1"


def test_markers_of_starloc_get_the_ids_of_their_radios(tmp_path: Path):
    source = open_mapped(starloc(tmp_path), "starloc")
    assert sorted(source.anchors.index) == sorted(MARKERS.values())
    assert not source.warnings


def test_wrong_anchor_ids_and_swapped_columns_are_reported_by_anchor(tmp_path: Path):
    document = load_mapping("starloc").model_dump()
    document["anchors"] = {**document["anchors"][0], "id": "Unnamed: 0"}
    differs, missing, unused = read(document, starloc(tmp_path)).warnings
    assert differs.startswith("true ranges and distances from positions differ for anchor 6 by ")
    assert all(f" {radio} by " in differs for radio in (6, 10, 11, 12))
    assert " 9 by " not in differs
    assert missing == "3 of 8 anchors have no position: 4, 5, 7: compare the ids"
    assert unused == "3 anchors have a position but no range: 13, 15, 16"
    warnings = open_mapped(starloc(tmp_path / "swapped", swapped=True), "starloc").warnings
    assert warnings[0] == "1 of 1 anchors have no position: 1: are tag and anchor exchanged?"


def test_delay_of_cirs_and_the_offset_that_attaches_them_are_reported(tmp_path: Path):
    times = np.cumsum(np.random.default_rng(0).uniform(0.05, 0.3, 200))
    lines = [f'{t + 0.12:.4f},{n % 3},"[1, 2]"\n' for n, t in enumerate(times)]
    write(tmp_path / "cirs.csv", "t,a,c\n" + "".join(lines))
    text = "t,a,r\n" + "".join(f"{t:.4f},{n % 3},2\n" for n, t in enumerate(times))
    join = {"stamp": "t", "anchor": "a", "tolerance_s": 0.03}
    (warning,) = of(text, tmp_path / "x.csv", cir={"files": "cirs.csv", "column": "c", "join": join}).warnings
    assert "of 200; typical delay +0.12 s; cir.join.stamp with offset: -0.120 would attach more" in warning
    join["stamp"] = {"column": "t", "offset": -0.12}
    source = of(text, tmp_path / "x.csv", cir={"files": "cirs.csv", "column": "c", "join": join})
    assert not source.warnings
    assert [note.replace("-0.00", "+0.00") for note in source.notes] == [
        "CIRs attached: 200 of 200; typical delay +0.00 s"
    ]


def test_stamps_are_kept_unless_ros_cannot_represent_them(tmp_path: Path):
    source = of("t,a,r\n" + "".join(f"{n / 10},1,2\n" for n in range(20)), tmp_path / "x.csv")
    assert source.values["stamp"].tolist() == [n * 10**8 for n in range(20)]
    source = of("t,a,r\n" + "".join(f"{n / 10 - 7.5},1,2\n" for n in range(20)), tmp_path / "y.csv")
    assert source.warnings == ["+8 s were added to all stamps, because those of ROS are from 1970 to 2038"]
    assert next(iter(source)).measurement.stamp_ns == 500_000_000


@pytest.mark.parametrize(
    ("step", "unit", "message"),
    [
        (100, "s", "100 s apart.*unit: ms"),
        (0.1, "ms", "0.0001 s apart.*unit: s of the stamps"),
        (0.0001, "s", r"unit: s, scale: 3600 \(hours\)"),
        (100_000, "s", "unit: us"),
        (100_000, "ms", "unit: us"),
        (1 / 864_000, "s", r"unit: s, scale: 86400 \(days\)"),
    ],
)
def test_implausible_rate_is_an_error(step: float, unit: str, message: str, tmp_path: Path):
    text = "t,a,r\n" + "".join(f"{n * step:.9f},1,2\n" for n in range(50))
    with pytest.raises(RecordingError, match=message):
        of(text, tmp_path / "x.csv", **with_fields(stamp={"column": "t", "unit": unit}))
    # Placements may be minutes apart.
    assert step != 100 or len(of(text, tmp_path / "x.csv", moving=False)) == 50


@pytest.mark.parametrize(("unit", "metres"), [("ft", 0.3048), ("in", 0.0254)])
def test_feet_and_inches_are_found_by_the_truth(unit: str, metres: float, tmp_path: Path):
    rng = np.random.default_rng(1)
    true = rng.uniform(1, 6, 100)
    measured = (true + rng.exponential(0.2, 100) + 0.3) / metres
    text = "t,a,r,true\n" + "".join(f"{n / 10},1,{measured[n]:.3f},{true[n]:.3f}\n" for n in range(100))
    with pytest.raises(RecordingError, match=f"times the true ranges.*unit: {unit} of range"):
        of(text, tmp_path / "x.csv", truth={"range": "true"})
    fields = with_fields(range={"column": "r", "unit": unit})
    source = of(text, tmp_path / "x.csv", **fields | {"truth": {"range": "true"}})
    assert 0.3 < np.median(source.errors_m) < 0.6


@pytest.mark.parametrize(
    ("end", "warning"),
    [
        ("2,1,", "does not end with a line break"),
        ("2,1,1", "does not end"),
        ("2,1\n", "the last row is short"),
    ],
)
def test_cut_last_row_is_dropped_and_reported(end: str, warning: str, tmp_path: Path):
    source = of(f"t,a,r\n0,1,2\n1,1,3\n{end}", tmp_path / "x.csv")
    assert ranges_of(source) == [2.0, 3.0]
    (reported,) = source.warnings
    assert warning in reported


def test_placements_without_stamps_are_separated_by_pauses(tmp_path: Path):
    rows = "".join(f"{n % 4},{2 + n / 100},{n // 20 % 3},0,0,link{n % 4}\n" for n in range(120))
    truth: dict[str, Any] = {"tag_position": ["x", "y", "z"], "configuration": "where"}
    document = with_fields(stamp={"rate_hz": 10}) | {"moving": False, "truth": truth}
    source = of(f"a,r,x,y,z,where\n{rows}", tmp_path / "x.csv", **document)
    gaps = np.diff(source.values["stamp"] / 1e9)
    assert (gaps > 1).sum() == 2
    assert gaps.max() == pytest.approx(5.0)
    assert source.values["tag x"].tolist() == [0.0] * 40 + [1.0] * 40 + [2.0] * 40
    assert source.notes == ["3 placements, with pauses of 5 s between them"]
    del truth["tag_position"]
    assert read(document, tmp_path / "x.csv").notes == ["4 placements, with pauses of 5 s between them"]


def test_wide_tables_have_one_row_for_each_pair(tmp_path: Path):
    document = {
        "unpivot": {"range": r"r(\d+)", "level": r"s(\d+)"},
        "fields": {"stamp": "t", "anchor": "variable", "range": "range", "rx_power": "level"},
    }
    source = of("t,r1,s1,r12,s12\n0,2.5,-80,3.5,-81\n0.1,2.6,-82,,-83\n", tmp_path / "x.csv", **document)
    assert values_of(source) == [(0.0, 1, 1, 2.5), (0.0, 1, 12, 3.5), (0.1, 1, 1, 2.6)]
    assert [one.measurement.cir.rx_power_dbm for one in source] == [-80.0, -81.0, -82.0]
    assert source.dropped == {"range is not a number": 1}
    with pytest.raises(RecordingError, match=r"no column matches unpivot 'x\(.*t, r1, s1"):
        read(PLAIN | document | {"unpivot": {"range": r"x(\d)"}}, tmp_path / "x.csv")
    savemat(tmp_path / "x.mat", {"t": np.array([0.0, 0.1]), "dist": np.array([[2.5, 3.5], [2.6, np.nan]])})
    matrix = with_fields(anchor="variable", range="value") | {"unpivot": {"value": "dist"}}
    found = values_of(read(matrix, tmp_path / "x.mat"))
    assert found == [(0.0, 1, 1, 2.5), (0.0, 1, 2, 3.5), (0.1, 1, 1, 2.6)]


def test_dry_run_shows_units_errors_outliers_names_and_what_is_missing(tmp_path: Path):
    fields = {"stamp": "t", "anchor": {"column": "a", "names": True}, "range": "r", "rx_power": "l"}
    truth = {"range": {"column": "true", "unit": "cm"}}
    write(tmp_path / "map.yaml", yaml.safe_dump(PLAIN | {"fields": fields, "truth": truth}))
    rows = "".join(
        f"{n / 10},{'hall' if n % 2 else 'lab'},{500 if n == 7 else 2},-80,190\n" for n in range(41)
    )
    write(tmp_path / "x.csv", f"t,a,r,l,true\n{rows}4.1,lab,1e297,-80,190\n")
    done = succeed("data import x.csv --map map.yaml --dry-run --json x.json", folder=tmp_path)
    for shown in (
        "4.0 s, 2 pairs with 20 to 21 ranges (5 to 5.2 Hz)",
        "true range, m",
        "1.900",
        "Errors (measured - true) of 41 ranges",
        "41 of 41 ranges have no CIR",
        "Dropped 1 rows: range is above 10000",
        "fewer than 3 placements",
        "no positions of the anchors",
        "anchor name",
        "no first-path level",
    ):
        assert shown in done.stdout
    assert "warning: 1 ranges are above 100 m" in done.stderr
    assert "warning: 1 errors are above 5 m" in done.stderr
    assert [line.split()[1:4:2] for line in done.stdout.splitlines() if "hall" in line] == [["hall", "2"]]
    assert "no receive level" not in done.stdout
    assert sorted(path.name for path in tmp_path.iterdir()) == ["map.yaml", "x.csv", "x.json"]


def test_chunks_without_rows_do_not_change_the_others(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("uwb_mitigation.recordings.text_blocks.BLOCK_CHARS", 8)
    text = "t,a,r\n" + "".join(f"{n / 10},1,{-1 if n in (0, 1, 5) else n}\n" for n in range(8))
    source = of(text, tmp_path / "x.csv", drop=[{"column": "r", "below": 0}])
    assert ranges_of(source) == [2.0, 3.0, 4.0, 6.0, 7.0]
    assert (source.values["cir"] == -1).all()


@pytest.mark.parametrize(
    ("values", "problem"),
    [
        ([round(40.0 + 30.0 / (1.0 + n), 2) for n in range(200)], "a CIR in dB"),
        ([(-1) ** n * 40 for n in range(200)], "negative magnitudes (cir.samples: interleaved, or complex)"),
    ],
)
def test_cirs_that_are_no_magnitudes_are_refused_with_their_row(
    tmp_path: Path, values: list[float], problem: str
):
    text = " ".join(map(str, values))
    cir = {"column": "cir", "samples": "magnitude"}
    with pytest.raises(RecordingError, match=re.escape(f"row 1: {problem}")):
        list(of(f't,a,r,cir\n0,2,3.0,"{text}"\n', tmp_path / "x.csv", cir=cir))
