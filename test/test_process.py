"""`uwb-mitigation process`: copies all messages, corrects all ranges, and leaves no partial files."""

import json
import os
import signal
import subprocess
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from bag_material import START_NS, Foreign, damage_after_first_chunk, write_records
from command_line import ENVIRONMENT, command, run, start, succeed
from conftest import REPOSITORY
from firmware_models import random_measurement
from model_material import cir
from port_events import wait_until

from uwb_mitigation.commands.offline import parallel
from uwb_mitigation.commands.offline.parallel import plan, run_locally, run_on_dask
from uwb_mitigation.commands.offline.process import Job, process_bag
from uwb_mitigation.errors import ParameterError
from uwb_mitigation.mitigation.correction import Mitigation
from uwb_mitigation.mitigation.model.bundle import load_bundle
from uwb_mitigation.mitigation.model.shipped import shipped_model_path
from uwb_mitigation.recordings.bag.reader import BagReader
from uwb_mitigation.types.measurement import Encoding, RadioType, RangeMeasurement, Record, Segment, Truth
from uwb_mitigation.types.offsets import NO_OFFSETS, Offsets
from uwb_mitigation.types.ros import codec
from uwb_mitigation.types.ros.topics import RANGE_CORRECTED, RANGE_RAW


def exchange(number: int) -> RangeMeasurement:
    stamp_ns, range_m = START_NS + number * 10_000_000, 3.0 + number * 0.125
    received = cir(number, sample_period_s=float(np.float32(1.0016e-9)))
    return RangeMeasurement(stamp_ns, 7, 1 + number % 3, number, number, range_m, received, "antenna")


def write_bag(path: Path, measurements: list[RangeMeasurement]) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    return write_records(path, (Record(measured, Truth(2.5, "LOS", "here")) for measured in measurements))


def exchanges(count: int) -> list[RangeMeasurement]:
    return [exchange(number) for number in range(count)]


def job(source: Path, output: Path, **options: object) -> Job:
    return Job(source, output, shipped_model_path("evk1000_apartment"), **options)  # type: ignore[arg-type]


def corrected_of(path: Path) -> list[bytes]:
    return [message.data for message in BagReader(path).messages([RANGE_CORRECTED])]


def one_by_one(measurements: list[RangeMeasurement], offsets: Offsets = NO_OFFSETS) -> list[bytes]:
    mitigation = Mitigation(
        load_bundle(shipped_model_path("evk1000_apartment")), offsets, median_at_rest=True
    )
    return [codec.encode_corrected(m, mitigation.correct([m])[0]) for m in measurements]


def test_batches_equal_single_corrections_bit_by_bit(tmp_path: Path) -> None:
    random = np.random.default_rng(6)
    drawn = [random_measurement(random) for _ in range(600)]
    # Ranges of several encodings are corrected singly.
    measurements = exchanges(300) + [m for m in drawn if m.cir.encoding is Encoding.COMPLEX_INT16]
    measurements = [
        replace(measured, stamp_ns=START_NS + number, frame_id="antenna")
        for number, measured in enumerate(measurements)
    ]
    outcome = process_bag(job(write_bag(tmp_path / "in.mcap", measurements), tmp_path / "out.mcap"))
    assert corrected_of(tmp_path / "out.mcap") == one_by_one(measurements)
    assert outcome.ranges == len(measurements) == outcome.statuses.total()
    assert set(outcome.statuses) >= {"OK", "NO_CIR", "BAD_CIR", "OUT_OF_DISTRIBUTION"}


def test_other_messages_and_those_that_do_not_decode_are_copied_byte_by_byte(tmp_path: Path) -> None:
    foreign = Foreign(tmp_path / "in.mcap").ours()
    foreign.channel("/picture", "sensor_msgs/msg/Image", "uint8[] data")
    foreign.channel("/notes", "", None, encoding="json")
    for number in range(40):
        foreign.range(number)
        foreign.add("/picture", START_NS + number, bytes([number]) * number)
        foreign.add("/notes", START_NS + number, b"{}")
    foreign.add(RANGE_RAW, START_NS + 50, b"\0\1\0\0garbage")
    source = foreign.finish()
    outcome = process_bag(job(source, tmp_path / "out.mcap"))
    assert (outcome.ranges, outcome.skipped) == (40, {"message ends early": 1})

    def others(path: Path) -> Counter[object]:
        return Counter(
            (m.channel.topic, m.channel.encoding, m.channel.schema, m[1:])
            for m in BagReader(path).messages()
            if m.channel.topic != RANGE_CORRECTED
        )

    assert others(tmp_path / "out.mcap") == others(source)


def test_corrected_ranges_of_the_input_are_replaced_and_counted(tmp_path: Path) -> None:
    process_bag(job(write_bag(tmp_path / "in.mcap", exchanges(30)), tmp_path / "once.mcap"))
    assert process_bag(job(tmp_path / "once.mcap", tmp_path / "twice.mcap")).replaced == 30
    assert [m[1:] for m in BagReader(tmp_path / "once.mcap").messages()] == [
        m[1:] for m in BagReader(tmp_path / "twice.mcap").messages()
    ]


def test_ranges_of_a_radio_without_model_are_counted_with_their_reason(tmp_path: Path) -> None:
    other = {"radio": RadioType.DW3000, "segment": Segment.STS}
    measured = [replace(each, cir=replace(each.cir, **other)) for each in exchanges(12)]
    silent = replace(exchange(20), cir=replace(cir(20), samples=np.zeros_like(cir(20).samples)))
    write_bag(tmp_path / "in.mcap", [*exchanges(3), *measured, silent])
    words = "process in.mcap -o out.mcap --model evk1000_apartment --json out.json"
    text = " ".join(succeed(*words.split(), folder=tmp_path).stderr.split())
    assert "12 ranges are not corrected: they are of DW3000 STS" in text
    assert "trained for DW1000 IPATOV" in text
    assert "1 ranges are not corrected: the window contains only zeros" in text
    (counts,) = [bag["mismatches"] for bag in json.loads((tmp_path / "out.json").read_text())["bags"]]
    assert list(counts.values()) == [12]


def test_offsets_of_a_file_are_subtracted_for_each_pair(tmp_path: Path) -> None:
    write_bag(tmp_path / "in.mcap", exchanges(30))
    # One of the three anchors has an offset, and one has an offset with this tag.
    offsets = "default: 0.2\nanchors: {2: 0.35}\npairs: [{anchor: 3, tag: 7, offset: -0.1}]\n"
    (tmp_path / "offsets.yaml").write_text(offsets)
    words = "process in.mcap -o out.mcap --offsets offsets.yaml --model evk1000_apartment --json out.json"
    assert "30 ranges" in succeed(*words.split(), folder=tmp_path).stdout
    result = json.loads((tmp_path / "out.json").read_text())
    assert (result["ranges"], result["messages"], result["failed"]) == (30, 60, 0)
    assert result["ranges_per_s"] > 0
    assert {path.name for path in tmp_path.iterdir()} == {"in.mcap", "offsets.yaml", "out.json", "out.mcap"}
    expected = one_by_one(exchanges(30), Offsets(0.2, {2: 0.35}, pairs={(7, 3): -0.1}))
    assert corrected_of(tmp_path / "out.mcap") == expected
    without = [codec.decode_corrected(data)[1].correction_m for data in one_by_one(exchanges(30))]
    more = [codec.decode_corrected(data)[1].correction_m for data in expected]
    assert np.subtract(more, without)[:3] == pytest.approx([0.2, 0.35, -0.1], abs=1e-6)


def test_existing_output_is_kept_without_force(tmp_path: Path) -> None:
    source = write_bag(tmp_path / "in.mcap", exchanges(4))
    output = write_bag(tmp_path / "out.mcap", exchanges(1))
    refused = run("process", source, "-o", output, folder=tmp_path)
    assert refused.returncode == 2
    assert "--force" in refused.stderr
    assert corrected_of(output) == []
    succeed("process", source, "-o", output, "--force", folder=tmp_path)
    assert len(corrected_of(output)) == 4


def test_invalid_bag_is_reported_and_does_not_stop_the_others(tmp_path: Path) -> None:
    folder = tmp_path / "monday"
    write_bag(folder / "a.mcap", exchanges(9))
    write_bag(folder / "later" / "b", exchanges(8))
    end = damage_after_first_chunk(write_bag(folder / "cut.mcap", exchanges(400)))
    (folder / "bad.mcap").write_bytes(b"nothing")
    done = start("process monday -o out --model evk1000_apartment --json out.json", folder=tmp_path)
    assert done.returncode == 1
    for text in ("bad.mcap: not an MCAP file", f"cut.mcap, byte {end}", "2 of 4 bags failed"):
        assert text in done.stderr
    files = sorted(str(p.relative_to(tmp_path / "out")) for p in (tmp_path / "out").rglob("*") if p.is_file())
    assert files == ["a.mcap", "cut.mcap", "later/b/b_0.mcap", "later/b/metadata.yaml"]
    result = json.loads((tmp_path / "out.json").read_text())
    errors = {Path(bag["source"]).name: bag["error"] for bag in result["bags"]}
    assert result["failed"] == 2
    assert errors["a.mcap"] is errors["b"] is None
    assert "not an MCAP file" in errors["bad.mcap"]
    before = corrected_of(tmp_path / "out" / "cut.mcap")
    assert 0 < len(before) < 400
    assert before == one_by_one(exchanges(len(before)))


@pytest.mark.parametrize(
    ("given", "excerpt"),
    [
        (["absent.mcap", "-o", "out.mcap"], "absent.mcap: no such file"),
        (["in.mcap", "in.mcap", "-o", "out"], "have the same name"),
        (["in.mcap", "other.mcap", "-o", "out.mcap"], "one output file for several bags"),
        (["empty", "-o", "out"], "contains no MCAP bag"),
        (["in.mcap", "-o", "out.mcap", "--model", "absent.onnx"], "absent.onnx"),
        (["in.mcap", "-o", "out.mcap", "--offsets", "absent.yaml"], "absent.yaml"),
        (["in.mcap", "-o", "no/such/folder.mcap"], "the folder of the output does not exist"),
    ],
)
def test_invalid_arguments_are_reported_in_one_line(tmp_path: Path, given: list[str], excerpt: str) -> None:
    write_bag(tmp_path / "in.mcap", exchanges(1))
    write_bag(tmp_path / "other.mcap", exchanges(1))
    (tmp_path / "empty").mkdir()
    done = run("process", *given, folder=tmp_path)
    assert done.returncode in (1, 2)
    assert excerpt in done.stderr
    assert len(done.stderr.splitlines()) == 1
    assert not (tmp_path / "out").exists()
    assert not (tmp_path / "out.mcap").exists()


@pytest.mark.parametrize(
    ("sources", "output", "written"),
    [
        (["one", "two"], "one/out", ["one/out/one/a.mcap", "one/out/one/sub/b.mcap", "one/out/two/a.mcap"]),
        (["two"], "x", ["x/a.mcap"]),
    ],
)
def test_folders_of_sources_are_kept_and_earlier_outputs_skipped(
    sources: list[str], output: str, written: list[str], tmp_path: Path
) -> None:
    for name in ("one/a.mcap", "one/sub/b.mcap", "two/a.mcap", "one/out/c.mcap"):
        write_bag(tmp_path / name, [])
    planned = plan([tmp_path / name for name in sources], tmp_path / output)
    assert [str(output.relative_to(tmp_path)) for output in planned] == written


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signal_leaves_no_partial_file(number: signal.Signals, tmp_path: Path) -> None:
    code, bags = tmp_path / "code", tmp_path / "bags"
    code.mkdir()
    # The first message is not written before the signal. A signal just before a sleep is handled after it.
    (code / "sitecustomize.py").write_text(
        "import pathlib, time\n"
        "from uwb_mitigation.commands.offline import process as job\n"
        "class Waiting(job.BagWriter):\n"
        "    def write_serialized(self, *arguments, **options):\n"
        f"        pathlib.Path({str(code / 'waits')!r}).touch()\n"
        "        while True:\n"
        "            time.sleep(0.1)\n"
        "job.BagWriter = Waiting\n"
    )
    words = command("process", write_bag(bags / "in.mcap", exchanges(9)), "-o", "out.mcap")
    output = {"stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE}
    environment = ENVIRONMENT | {"PYTHONPATH": f"{code}:{REPOSITORY}"}
    with subprocess.Popen(words, cwd=bags, env=environment, start_new_session=True, **output) as process:
        wait_until((code / "waits").exists)
        os.killpg(process.pid, number)
        _, stderr = process.communicate(timeout=240)
    assert process.returncode == 128 + number, stderr
    assert b"Traceback" not in stderr
    assert [path.name for path in bags.iterdir()] == ["in.mcap"]


def test_crashed_worker_loses_only_its_bag(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    jobs = [
        job(write_bag(tmp_path / f"in{n}.mcap", exchanges(9)), tmp_path / f"out{n}.mcap") for n in range(3)
    ]
    # The system kills a process if memory runs out, here after another one has written its output but not returned.
    (tmp_path / "sitecustomize.py").write_text(
        "import os, pathlib, signal, time\n"
        "from uwb_mitigation.commands.offline import process as job\n"
        f"written = pathlib.Path({str(tmp_path / 'written')!r})\n"
        "process = job.process_bag\n"
        "def killed(one, report):\n"
        "    if one.source.name == 'in1.mcap':\n"
        "        while not written.exists():\n"
        "            time.sleep(0.01)\n"
        "        os.kill(os.getpid(), signal.SIGKILL)\n"
        "    outcome = process(one, report)\n"
        "    if one.source.name == 'in0.mcap' and not written.exists():\n"
        "        written.touch()\n"
        "        time.sleep(600)\n"
        "    return outcome\n"
        "job.process_bag = killed\n"
    )
    monkeypatch.setenv("PYTHONPATH", f"{tmp_path}:{REPOSITORY}")
    # Start new processes, because a server of processes, if another test started one, did not read `sitecustomize`.
    monkeypatch.setattr(parallel.multiprocessing, "get_all_start_methods", list)
    finished = {one.job.source.name: one.error is None for one in run_locally(jobs, 2)}
    assert finished == {"in0.mcap": True, "in1.mcap": False, "in2.mcap": True}
    assert not list(tmp_path.glob("*.part"))


def test_dask_cluster_gives_the_same_result_and_continues_after_an_invalid_bag(tmp_path: Path) -> None:
    distributed = pytest.importorskip("distributed", reason="python -m pip install distributed")
    sources = [write_bag(tmp_path / f"in{n}.mcap", exchanges(50)) for n in range(3)]
    sources[1].write_bytes(b"nothing of the kind")
    jobs = [job(source, tmp_path / f"{source.stem}_out.mcap") for source in sources]
    local = {"dashboard_address": None, "host": "127.0.0.1", "env": {"PYTHONPATH": str(REPOSITORY)}}
    with distributed.LocalCluster(n_workers=1, threads_per_worker=1, processes=True, **local) as cluster:
        outcomes = {outcome.job: outcome for outcome in run_on_dask(jobs, cluster.scheduler_address)}
    assert "not an MCAP file" in str(outcomes[jobs[1]].error)
    for number in (0, 2):
        assert outcomes[jobs[number]].error is None
        assert corrected_of(jobs[number].output) == one_by_one(exchanges(50))


def test_unreachable_scheduler_is_named(tmp_path: Path) -> None:
    pytest.importorskip("distributed", reason="python -m pip install distributed")
    dask = pytest.importorskip("dask")
    with dask.config.set({"distributed.comm.timeouts.connect": "200ms"}):
        for address in ("tcp://127.0.0.1:9", "nonsense://127.0.0.1:9"):
            with pytest.raises(ParameterError, match="no Dask scheduler"):
                list(run_on_dask([job(tmp_path / "a", tmp_path / "b")], address))
