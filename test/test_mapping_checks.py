"""What mapped recordings report: wrong anchors, units, stamps, CIRs, damage; and lists, wide tables, placements."""

from __future__ import annotations

import signal
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from command_line import ENVIRONMENT, command, run, succeed
from mcap.writer import Writer as McapWriter
from port_events import wait_until
from test_mapping import PLAIN, _message_store, _write_bag, read, with_fields, write

from uwb_mitigation.errors import DamagedRecordingError, RecordingError
from uwb_mitigation.recordings.formats import open_mapped
from uwb_mitigation.recordings.mapping.mapping import TableFormat, load_mapping
from uwb_mitigation.recordings.mapping.messages import MessageRows
from uwb_mitigation.recordings.mcap import McapRecording

MARKERS = {6: 12, 9: 9, 10: 11, 11: 7, 12: 4, 13: 10, 15: 5, 16: 6}
"""Radio next to each marker of STAR-loc's sessions 1 and 2."""


def starloc(folder: Path, session: str = "loop-2d_s1", swapped: bool = False) -> Path:
    positions = {marker: np.array([3.0 * n, 5.0 - 2 * n, n / 2]) for n, marker in enumerate(MARKERS)}
    rows = "".join(f"{marker},{x},{y},{z}\n" for marker, (x, y, z) in positions.items())
    write(folder / "mocap/uwb_markers_v1.csv", f",x,y,z\n{rows}")
    lines = ["time_s,to_id,range,from_id,tag_pos_x,tag_pos_y,tag_pos_z,gt_range"]
    for n in range(400):
        marker, tag = list(MARKERS)[n % 8], np.array([n / 100, 1.0, 1.0])
        distance = np.linalg.norm(positions[marker] - tag)
        first, second = (1, MARKERS[marker]) if swapped else (MARKERS[marker], 1)
        lines.append(f"{n / 50},{first},{distance + 0.1},{second},{tag[0]},1,1,{distance}")
    write(folder / f"data/{session}/uwb.csv", "\n".join(lines))
    return folder / "data" / session


def test_markers_of_starloc_get_the_ids_of_their_radios(tmp_path: Path):
    source = open_mapped(starloc(tmp_path), "starloc")
    assert sorted(source.anchors.index) == sorted(MARKERS.values())
    assert not source.warnings


def test_wrong_anchor_ids_and_swapped_columns_are_reported_by_anchor(tmp_path: Path):
    document = yaml.safe_load(
        (Path(load_mapping.__code__.co_filename).parents[1] / "mappings/starloc.yaml").read_text()
    )
    document["anchors"] = {**document["anchors"][0], "id": "Unnamed: 0"}
    differs, missing, unused = read(document, starloc(tmp_path)).warnings
    assert differs.startswith("true ranges and distances from positions differ for anchor 6 by ")
    assert all(f" {radio} by " in differs for radio in (6, 10, 11, 12))
    assert " 9 by " not in differs
    assert missing == "3 of 8 anchors have no position: 4, 5, 7: compare the ids"
    assert unused == "3 anchors have a position but no range: 13, 15, 16"
    warnings = open_mapped(starloc(tmp_path / "swapped", swapped=True), "starloc").warnings
    assert warnings[0] == "1 of 1 anchors have no position: 1: are tag and anchor exchanged?"


def cirs(folder: Path, delay_s: float) -> dict[str, Any]:
    rng = np.random.default_rng(0)
    times = np.cumsum(rng.uniform(0.05, 0.3, 200))
    write(folder / "x.csv", "t,a,r\n" + "".join(f"{t:.4f},{n % 3},2\n" for n, t in enumerate(times)))
    lines = [f'{t + delay_s:.4f},{n % 3},"[1, 2]"\n' for n, t in enumerate(times)]
    write(folder / "cirs.csv", "t,a,c\n" + "".join(lines))
    join = {"stamp": "t", "anchor": "a", "tolerance_s": 0.03}
    return PLAIN | {"cir": {"files": "cirs.csv", "column": "c", "join": join}}


def test_delay_of_cirs_and_the_offset_that_attaches_them_are_reported(tmp_path: Path):
    document = cirs(tmp_path, 0.12)
    source = read(document, tmp_path / "x.csv")
    (warning,) = source.warnings
    assert "of 200; typical delay +0.12 s; cir.join.stamp with offset: -0.120 would attach more" in warning
    document["cir"]["join"]["stamp"] = {"column": "t", "offset": -0.12}
    source = read(document, tmp_path / "x.csv")
    assert not source.warnings
    assert [note.replace("-0.00", "+0.00") for note in source.notes] == [
        "CIRs attached: 200 of 200; typical delay +0.00 s"
    ]


def test_stamps_are_kept_unless_ros_cannot_represent_them(tmp_path: Path):
    write(tmp_path / "map.yaml", yaml.safe_dump(PLAIN))
    write(tmp_path / "x.csv", "t,a,r\n" + "".join(f"{n / 10},1,2\n" for n in range(20)))
    succeed("data", "import", "x.csv", "--map", "map.yaml", "-o", "x.mcap", folder=tmp_path)
    stamps = [record.measurement.stamp_ns for record in McapRecording(tmp_path / "x.mcap")]
    assert stamps == [n * 10**8 for n in range(20)]
    write(tmp_path / "y.csv", "t,a,r\n" + "".join(f"{n / 10 - 7.5},1,2\n" for n in range(20)))
    source = read(PLAIN, tmp_path / "y.csv")
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
    write(tmp_path / "x.csv", "t,a,r\n" + "".join(f"{n * step:.9f},1,2\n" for n in range(50)))
    with pytest.raises(RecordingError, match=message):
        read(with_fields(stamp={"column": "t", "unit": unit}), tmp_path / "x.csv")
    # Placements may be minutes apart.
    if step == 100:
        assert len(read(with_fields() | {"moving": False}, tmp_path / "x.csv")) == 50


@pytest.mark.parametrize(("unit", "metres"), [("ft", 0.3048), ("in", 0.0254)])
def test_feet_and_inches_are_found_by_the_truth(unit: str, metres: float, tmp_path: Path):
    rng = np.random.default_rng(1)
    true = rng.uniform(1, 6, 100)
    measured = (true + rng.exponential(0.2, 100) + 0.3) / metres
    rows = "".join(
        f"{n / 10},1,{r:.3f},{t:.3f}\n" for n, (r, t) in enumerate(zip(measured, true, strict=True))
    )
    write(tmp_path / "x.csv", "t,a,r,true\n" + rows)
    truth = {"truth": {"range": "true"}}
    with pytest.raises(RecordingError, match=f"times the true ranges.*unit: {unit} of range"):
        read(PLAIN | truth, tmp_path / "x.csv")
    source = read(with_fields(range={"column": "r", "unit": unit}) | truth, tmp_path / "x.csv")
    assert 0.3 < np.median(source.errors_m) < 0.6


def test_a_large_offset_is_no_unit(tmp_path: Path):
    true = np.linspace(2, 8, 50)
    rows = "".join(f"{n / 10},1,{t * 1.02 + 11:.3f},{t:.3f}\n" for n, t in enumerate(true))
    write(tmp_path / "x.csv", "t,a,r,true\n" + rows)
    assert len(read(PLAIN | {"truth": {"range": "true"}}, tmp_path / "x.csv")) == 50


@pytest.mark.parametrize(
    ("end", "warning"),
    [
        ("2,1,", "does not end with a line break"),
        ("2,1,1", "does not end"),
        ("2,1\n", "the last row is short"),
    ],
)
def test_cut_last_row_is_dropped_and_reported(end: str, warning: str, tmp_path: Path):
    (tmp_path / "x.csv").write_text(f"t,a,r\n0,1,2\n1,1,3\n{end}")
    source = read(PLAIN, tmp_path / "x.csv")
    assert [record.measurement.range_m for record in source] == [2.0, 3.0]
    assert len(source.warnings) == 1
    assert warning in source.warnings[0]


@pytest.mark.parametrize("name", ["one.bag", "two/two.db3", "three/three.mcap"])
def test_truncated_bag_is_read_up_to_the_damage(name: str, tmp_path: Path):
    store, kind = _message_store()
    path = tmp_path / name
    if name.endswith(".mcap"):
        path.parent.mkdir()
        with path.open("wb") as stream:
            writer = McapWriter(stream, chunk_size=5000)
            writer.start("ros2")
            text, _ = store.generate_msgdef(kind, ros_version=2)
            schema = writer.register_schema(kind, "ros2msg", text.encode())
            channel = writer.register_channel("/nlink_linktrack_nodeframe2", "cdr", schema)
            for stamp, data in _messages(tmp_path, store, kind, 900):
                writer.add_message(channel, stamp, data, stamp)
            writer.finish()
    else:
        _write_bag(path if name.endswith(".bag") else path.parent, store, kind, 900)
    complete = path.read_bytes()
    path.write_bytes(complete[: int(len(complete) * 0.65)])
    (path.parent / "metadata.yaml").unlink(missing_ok=True)
    source = open_mapped(path, "nlink_nodeframe2")
    assert 100 < len(source) < 1800
    with pytest.raises(DamagedRecordingError):
        list(source)
    assert "only the rows before are used" in source.warnings[0]


def _messages(folder: Path, store: Any, kind: str, count: int) -> list[tuple[int, bytes]]:
    from rosbags.highlevel import AnyReader

    _write_bag(folder / "original", store, kind, count)
    with AnyReader([folder / "original"]) as reader:
        return [(stamp, bytes(data)) for _, stamp, data in reader.messages()]


def test_placements_without_stamps_are_separated_by_pauses(tmp_path: Path):
    rows = "".join(f"{n % 4},{2 + n / 100},{n // 20 % 3},0,0,link{n % 4}\n" for n in range(120))
    write(tmp_path / "x.csv", f"a,r,x,y,z,where\n{rows}")
    document = with_fields(stamp={"rate_hz": 10}) | {
        "moving": False, "truth": {"tag_position": ["x", "y", "z"], "configuration": "where"}
    }  # fmt: skip
    source = read(document, tmp_path / "x.csv")
    stamps = source.values["stamp"] / 1e9
    gaps = np.diff(stamps)
    assert (gaps > 1).sum() == 2
    assert gaps.max() == pytest.approx(5.0)
    assert source.values["tag x"].tolist() == [0.0] * 40 + [1.0] * 40 + [2.0] * 40
    assert source.notes == ["3 placements, with pauses of 5 s between them"]
    del document["truth"]["tag_position"]
    assert read(document, tmp_path / "x.csv").notes == ["4 placements, with pauses of 5 s between them"]


def test_lists_in_lists_of_messages_are_rows():
    rows = MessageRows(TableFormat(), {"id": False, "nodes[].id": False, "nodes[].dis_arr[]": False})
    message = {"id": 9, "nodes": [{"id": 1, "dis_arr": [0.5, 0.6]}, {"id": 2, "dis_arr": [0.7]}]}
    assert rows.rows(message) == {
        "#": [0, 1, 0], "id": [9, 9, 9], "nodes[].id": [1, 1, 2], "nodes[].dis_arr[]": [0.5, 0.6, 0.7],
    }  # fmt: skip


def test_linktrack_anchor_frames(tmp_path: Path):
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    tag = "uint8 role\nuint8 id\nfloat32[3] pos_3d\nfloat32[8] dis_arr\n"
    frame = (
        "uint8 role\nuint8 id\nuint32 local_time\nuint32 system_time\nfloat32 voltage\nLinktrackTag[] nodes\n"
    )
    store, kind = get_typestore(Stores.ROS2_JAZZY), "nlink_parser/msg/LinktrackAnchorframe0"
    store.register(get_types_from_msg(tag, "nlink_parser/msg/LinktrackTag"))
    store.register(get_types_from_msg(frame, kind))
    types = store.types
    distances = np.array([1.5, 0, 2.5, 0, 0, 0, 0, 0], np.float32)
    nodes = [
        types["nlink_parser/msg/LinktrackTag"](2, tag, np.zeros(3, np.float32), distances + (tag > 3) * 0)
        for tag in (3, 4)
    ]
    with Writer(tmp_path / "bag", version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        topic = writer.add_connection("/nlink_linktrack_anchorframe0", kind, typestore=store)
        for n in range(3):
            message = types[kind](1, 0, 0, 0, 5.0, nodes)
            writer.write(topic, (1000 + n) * 10**9, store.serialize_cdr(message, kind))
    source = open_mapped(tmp_path / "bag", "nlink_anchorframe0")
    ids = [
        (record.measurement.tag_id, record.measurement.anchor_id, record.measurement.range_m)
        for record in source
    ]
    assert ids == [(3, 0, 1.5), (3, 2, 2.5), (4, 0, 1.5), (4, 2, 2.5)] * 3
    # Without [] it is an error, not a traceback.
    document = load_mapping("nlink_nodeframe2").model_dump(exclude={"fields", "drop", "topics"}) | {
        "topics": ["/nlink_linktrack_anchorframe0"],
        "fields": {"tag": "nodes[].id", "anchor": 1, "range": "nodes[].dis_arr"},
    }
    with pytest.raises(RecordingError, match=r"contains lists .*nodes\[\].dis_arr\[\]"):
        read(document, tmp_path / "bag")


def test_wide_tables_have_one_row_for_each_pair(tmp_path: Path):
    write(tmp_path / "x.csv", "t,r1,s1,r12,s12\n0,2.5,-80,3.5,-81\n0.1,2.6,-82,,-83\n")
    document = {
        "name": "wide", "unpivot": {"range": r"r(\d+)", "level": r"s(\d+)"},
        "fields": {"stamp": "t", "anchor": "variable", "range": "range", "rx_power": "level"},
    }  # fmt: skip
    source = read(document, tmp_path / "x.csv")
    assert [
        (m.stamp_ns // 10**8, m.anchor_id, m.range_m, m.cir.rx_power_dbm)
        for m in (r.measurement for r in source)
    ] == [(0, 1, 2.5, -80.0), (0, 12, 3.5, -81.0), (1, 1, 2.6, -82.0)]
    assert source.dropped == {"range is not a number": 1}
    from scipy.io import savemat

    savemat(tmp_path / "x.mat", {"t": np.array([0.0, 0.1]), "dist": np.array([[2.5, 3.5], [2.6, np.nan]])})
    fields = {"stamp": "t", "anchor": "variable", "range": "value"}
    matrix = read({"name": "m", "unpivot": {"value": "dist"}, "fields": fields}, tmp_path / "x.mat")
    assert [(r.measurement.anchor_id, r.measurement.range_m) for r in matrix] == [
        (1, 2.5),
        (2, 3.5),
        (1, 2.6),
    ]
    with pytest.raises(RecordingError, match=r"no column matches unpivot 'x\(.*t, r1, s1"):
        read(document | {"unpivot": {"range": r"x(\d)"}}, tmp_path / "x.csv")


def test_dry_run_shows_extent_outliers_names_and_missing_levels(tmp_path: Path):
    fields = {"stamp": "t", "anchor": {"column": "a", "names": True}, "range": "r", "rx_power": "l"}
    write(tmp_path / "map.yaml", yaml.safe_dump(PLAIN | {"fields": fields}))
    rows = "".join(f"{n / 10},{'hall' if n % 2 else 'lab'},{500 if n == 7 else 2},-80\n" for n in range(41))
    write(tmp_path / "x.csv", f"t,a,r,l\n{rows}")
    done = succeed("data import x.csv --map map.yaml --dry-run --json x.json", folder=tmp_path)
    assert "4.0 s, 2 pairs with 20 to 21 ranges (5 to 5.2 Hz)" in done.stdout
    assert "warning: 1 ranges are above 100 m" in done.stderr
    assert "anchor name" in done.stdout
    assert [line.split()[1:4:2] for line in done.stdout.splitlines() if "hall" in line] == [["hall", "2"]]
    assert "no first-path level" in done.stdout
    assert "no receive level" not in done.stdout


def test_chunks_without_rows_do_not_change_the_others(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("uwb_mitigation.recordings.text_blocks.BLOCK_CHARS", 8)
    write(
        tmp_path / "x.csv",
        "t,a,r\n" + "".join(f"{n / 10},1,{-1 if n in (0, 1, 5) else n}\n" for n in range(8)),
    )
    source = read(PLAIN | {"drop": [{"column": "r", "below": 0}]}, tmp_path / "x.csv")
    assert [record.measurement.range_m for record in source] == [2.0, 3.0, 4.0, 6.0, 7.0]
    assert (source.values["cir"] == -1).all()


def test_missing_output_folder_is_an_error_before_reading(tmp_path: Path):
    (tmp_path / "map.yaml").write_text(yaml.safe_dump(PLAIN))
    done = run("data", "import", "absent.csv", "--map", "map.yaml", "-o", "no/x.mcap", folder=tmp_path)
    assert done.returncode == 2
    assert "the folder of the output does not exist" in done.stderr


def test_sigterm_removes_the_partial_file(tmp_path: Path):
    arguments = command("data", "simulate", "-o", "x.mcap", "--ranges", "200000")
    process = subprocess.Popen(arguments, cwd=tmp_path, env=ENVIRONMENT, stdout=subprocess.DEVNULL)
    try:
        wait_until((tmp_path / "x.mcap.part").exists)
        process.send_signal(signal.SIGTERM)
        assert process.wait(timeout=240) == 128 + signal.SIGTERM
    finally:
        process.kill()
    assert list(tmp_path.iterdir()) == []


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
    (tmp_path / "ranges.csv").write_text(f't,a,r,cir\n0,2,3.0,"{text}"\n')
    mapping = PLAIN | {"cir": {"column": "cir", "samples": "magnitude"}}
    (tmp_path / "map.yaml").write_text(yaml.safe_dump(mapping))
    done = run("data", "import", "ranges.csv", "--map", "map.yaml", "-o", "x.mcap", folder=tmp_path)
    assert done.returncode == 1
    assert f"row 1: {problem}" in done.stderr
