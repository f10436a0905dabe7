"""The model is chosen by the data: the rule, `process`, `track` and the live nodes without an option."""

import json
import re
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from bag_material import write_records
from command_line import succeed
from compilers import NEEDS_CC
from model_material import bundle, measurement
from ros_harness import Process, Ros, diagnostic_values
from uwb_mitigation_msgs.msg import RangeCorrected

from uwb_mitigation.calibration.site import calibrate
from uwb_mitigation.errors import ParameterError
from uwb_mitigation.mitigation.correction import Mitigation
from uwb_mitigation.mitigation.embedded.compiled import FirmwareMitigation
from uwb_mitigation.mitigation.model.choice import CirKind, choose_model
from uwb_mitigation.mitigation.model.shipped import load_model
from uwb_mitigation.mitigation.preprocessing import WINDOW_LEAD
from uwb_mitigation.recordings.bag.reader import BagReader
from uwb_mitigation.simulation.simulated import SimulatedSource
from uwb_mitigation.types.measurement import Cir, RadioType, RangeMeasurement, Record, Segment, Status, Truth
from uwb_mitigation.types.ros.codec import decode_corrected
from uwb_mitigation.types.ros.topics import RANGE_CORRECTED
from uwb_mitigation.types.stamps import to_ns

AUTO = load_model()
NAMES = {bundle.model_id: bundle.name for bundle in AUTO}
NAN = float("nan")
STS = {"radio": RadioType.DW3000, "segment": Segment.STS}


@pytest.mark.parametrize(
    ("changes", "name", "reason"),
    [
        ({}, "universal", "DW1000 IPATOV (assumed) with preamble count and levels: model universal, id "),
        ({"radio": RadioType.DW1000, "segment": Segment.IPATOV}, "universal", "DW1000 IPATOV with"),
        ({"preamble_count": 0}, "universal_amplitude", "without preamble count: model universal_amplitude"),
        ({"rx_power_dbm": NAN}, "universal_amplitude", "without levels"),
        ({"preamble_count": 0, "first_path_power_dbm": NAN}, "universal_amplitude", "preamble count and levels"),
        (STS, "dw3000_sts", "DW3000 STS with preamble count and levels: model dw3000_sts (experimental)"),
        (STS | {"samples": np.ones(24, np.int16)}, "", "dw3000_sts needs a CIR of 13 samples"),
        ({"samples": np.ones(312, np.int16)}, "", "universal needs a CIR of 157 samples"),
        ({"samples": np.zeros(0, np.int16)}, "", "of UNKNOWN without CIR, and no model in use fits: universal needs"),
        ({"radio": RadioType.QM35, "segment": Segment.STS}, "", "dw3000_sts was trained for DW3000 STS"),
    ],
)  # fmt: skip
def test_the_first_model_that_fits_the_data_is_chosen(changes: dict, name: str, reason: str) -> None:
    choice = choose_model(AUTO, CirKind.of(measurement(**changes).cir))
    assert choice.fits == bool(name)
    assert not name or AUTO[choice.model].name == name
    assert reason in str(choice)


def test_models_of_a_site_need_what_their_line_and_their_network_need(tmp_path: Path) -> None:
    line, network = ([bundle(tmp_path, needs_cir=needs_cir)] for needs_cir in (False, True))
    for changes, fits in (({"samples": np.zeros(0, np.int16)}, True), ({"rx_power_dbm": NAN}, False)):
        assert choose_model(line, CirKind.of(measurement(**changes).cir)).fits == fits
        assert not choose_model(network, CirKind.of(measurement(**changes).cir)).fits


def sts(each: RangeMeasurement) -> RangeMeasurement:
    """Return the range with the window of a UCI board, between other radios."""
    start = int(each.cir.first_path_index) - WINDOW_LEAD
    first = 2 * (start - each.cir.start_index)
    cir = Cir(
        each.cir.samples[first : first + 32], 0, start, each.cir.first_path_index, preamble_count=64, **STS
    )
    return replace(each, tag_id=202, anchor_id=each.anchor_id + 10, cir=cir)


def mixed(count: int) -> list[RangeMeasurement]:
    """Return ranges of a DW1000, in turn with those of a DW3000."""
    measured = [record.measurement for record in SimulatedSource(seed=2, count=count, rate_hz=40.0)]
    return [sts(each) if number % 2 else each for number, each in enumerate(measured)]


def without(each: RangeMeasurement, **changes: object) -> RangeMeasurement:
    return replace(each, cir=replace(each.cir, **changes))


BACKENDS = [Mitigation, pytest.param(FirmwareMitigation, marks=NEEDS_CC)]


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_mixed_batch_is_corrected_like_single_ranges_by_the_named_models(backend: type) -> None:
    ranges = mixed(60)
    ranges[::5] = [without(each, preamble_count=0) for each in ranges[::5]]
    ranges[::7] = [without(each, rx_power_dbm=NAN) for each in ranges[::7]]
    ranges[::11] = [without(each, samples=np.zeros(0, np.int16)) for each in ranges[::11]]
    named = {each.model_id: Mitigation(each, 0.22) for each in AUTO}
    auto = backend(AUTO, 0.22)
    results = auto.correct(ranges)
    used = [result.model_id for result in results]
    assert {NAMES[model_id] for model_id in used} == {"universal", "universal_amplitude", "dw3000_sts"}
    assert results == [auto.correct(each) for each in ranges]
    assert results == [named[model_id].correct(each) for each, model_id in zip(ranges, used, strict=True)]
    assert sum(auto.used.values()) == 2 * len(ranges)


def test_calibrate_starts_from_one_model() -> None:
    with pytest.raises(ParameterError, match="load_model"):
        calibrate([], SimulatedSource().anchors, AUTO)


def bag_of(path: Path, ranges: list[RangeMeasurement]) -> Path:
    """Write simulated ranges to a bag that is not marked as simulated."""
    return write_records(path, (Record(each, Truth(each.range_m, "LOS", "here")) for each in ranges), "false")


def corrected_in(path: Path) -> list[tuple[float, float, int, int]]:
    """Return range, variance, status and model of the corrected ranges of a bag, by stamp and anchor."""
    found = [decode_corrected(message.data) for message in BagReader(path).messages((RANGE_CORRECTED,))]
    found.sort(key=lambda pair: (pair[0].stamp_ns, pair[0].anchor_id))
    return [(each.range_m, each.variance_m2, each.status, each.model_id) for _, each in found]


@pytest.fixture
def mixed_bag(tmp_path: Path) -> Path:
    return bag_of(tmp_path / "mixed.mcap", mixed(160))


def test_process_and_evaluate_use_two_models_for_a_mixed_recording(mixed_bag: Path, tmp_path: Path) -> None:
    done = succeed("process mixed.mcap -o out.mcap --json out.json", folder=tmp_path)
    assert re.search(
        r"ranges of DW3000 STS without levels: model dw3000_sts \(experimental\), id", done.stdout
    )
    (row,) = json.loads((tmp_path / "out.json").read_text())["bags"]
    assert len(row["models"]) == 2
    assert not row["mismatches"]
    results = corrected_in(tmp_path / "out.mcap")
    done = succeed("evaluate --data mixed.mcap --json evaluated.json", folder=tmp_path)
    assert done.stdout.count("ranges of ") == 2
    assert json.loads((tmp_path / "evaluated.json").read_text())["statuses"]["OK"] == row["ok"]
    ok = Counter(NAMES[model_id] for *_, status, model_id in results if status == Status.OK)
    assert ok.keys() == {"universal", "dw3000_sts"}
    assert ok.total() > 0.95 * len(results)


def test_track_corrects_a_recording_of_raw_ranges_as_process_does(tmp_path: Path) -> None:
    succeed("data simulate --like drive --ranges 200 -o raw.mcap", folder=tmp_path)
    succeed("process raw.mcap --offsets 0.22 -o done.mcap", folder=tmp_path)
    options = "--anchors raw.anchors.yaml --height 0"
    succeed(f"track done.mcap {options} -o a.mcap --json a.json", folder=tmp_path)
    done = succeed(f"track raw.mcap {options} --offsets 0.22 -o b.mcap --json b.json", folder=tmp_path)
    assert "DW1000 IPATOV with preamble count and levels: model universal, id" in done.stdout
    first, second = (json.loads((tmp_path / name).read_text()) for name in ("a.json", "b.json"))
    assert first == second
    assert first["live"]["horizontal_rmse_m"] != first["raw_live"]["horizontal_rmse_m"]


def replayed(ros: Ros, bag: Path, count: int) -> tuple[list[tuple], Process]:
    """Replay a bag through driver and mitigator without an option; see `corrected_in`."""
    received = ros.collect(RangeCorrected, "/uwb/range_corrected")
    mitigator = ros.start("mitigator")
    mitigator.wait_for_output("correcting with model")
    # When the mitigator answers, it has discovered the subscription of this client.
    ros.spin_until(lambda: ros.state_of("mitigator") == "active")
    ros.start("driver", "source:=mcap", f"path:={bag}", "rate:=20.0", "wait_for_subscribers:=1")
    ros.spin_until(lambda: len(received) == count)
    received.sort(key=lambda each: (to_ns(each.header.stamp), each.anchor_id))
    return [(each.range, each.variance, each.status, each.model_id) for each in received], mitigator


@pytest.mark.ros
def test_a_mixed_recording_uses_two_models_at_the_same_time(ros: Ros, mixed_bag: Path):
    succeed("process mixed.mcap -o out.mcap", folder=mixed_bag.parent)
    offline = corrected_in(mixed_bag.parent / "out.mcap")
    live, mitigator = replayed(ros, mixed_bag, len(offline))
    assert live == offline
    for text in ("levels: model universal, id", "DW3000 STS without levels: model dw3000_sts (experimental)"):
        mitigator.wait_for_output(text)
    status = ros.diagnosis("mitigator", lambda status: "models by radio" in diagnostic_values(status))
    uses = diagnostic_values(status)["models by radio"]
    assert re.search(r"with preamble count and levels: model universal, id \w+ \(tag-anchor 101-1,", uses)
    assert re.search(r"DW3000 STS .* model dw3000_sts \(experimental\), id \w+ \(tag-anchor 202-1", uses)


@pytest.mark.ros
def test_ranges_without_a_model_are_reported_once(ros: Ros, tmp_path: Path):
    other = [without(each, radio=RadioType.QM35, segment=Segment.STS) for each in mixed(60)]
    live, mitigator = replayed(ros, bag_of(tmp_path / "other.mcap", other), len(other))
    assert {status for *_, status, _ in live} == {Status.OUT_OF_DISTRIBUTION}
    mitigator.wait_for_output("no model in use fits")
    status = ros.diagnosis("mitigator", lambda status: "no model in use fits" in status.message)
    assert "QM35 STS" in status.message
    assert mitigator.output.count("no model in use fits") == 2  # with and without levels


@pytest.mark.ros
def test_a_named_model_that_rejects_every_range_names_the_one_that_fits(ros: Ros, tmp_path: Path):
    unknown = {"preamble_count": 0, "rx_power_dbm": NAN, "first_path_power_dbm": NAN}
    unknown |= {"radio": RadioType.UNKNOWN, "segment": Segment.UNKNOWN}
    path = bag_of(tmp_path / "amplitudes.mcap", [without(each, **unknown) for each in mixed(400)[::2]])
    mitigator = ros.start("mitigator", "model:=universal")
    ros.start("driver", "source:=mcap", f"path:={path}", "rate:=0.5")
    mitigator.wait_for_output("with model:=auto: DW1000 IPATOV (assumed) without preamble count and levels")
    status = ros.diagnosis("mitigator", lambda status: "model universal_amplitude, id" in status.message)
    assert "the model is universal" in status.message
    assert mitigator.output.count("every range is rejected") == 1
    assert ros.set_parameter("mitigator", "model", "auto").successful
    ros.diagnosis("mitigator", lambda status: status.message == "correcting")
