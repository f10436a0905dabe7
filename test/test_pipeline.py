"""Driver and mitigator in one process: the same ranges, and no CIR without a subscriber."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS is not set up: run make setup")

from ros_harness import PAUSED, Ros
from uwb_mitigation_msgs.msg import RangeCir, RangeCorrected

from uwb_mitigation.mitigation.correction import Mitigation
from uwb_mitigation.mitigation.model.bundle import Session, load_bundle
from uwb_mitigation.mitigation.model.shipped import default_model_path
from uwb_mitigation.nodes import mitigator
from uwb_mitigation.simulation.simulated import SimulatedSource

pytestmark = pytest.mark.ros

RAW = "/uwb/range_raw"
CORRECTED = "/uwb/range_corrected"
PLAY = ("count:=200", "seed:=1", "simulated_rate:=400.0", *PAUSED)


def test_ranges_are_those_of_the_library_to_the_bit(ros: Ros):
    mitigation = Mitigation(load_bundle(default_model_path()))
    source = SimulatedSource(seed=1, count=200, rate_hz=400.0)
    expected = [mitigation.correct([record.measurement])[0] for record in source]
    received = ros.collect(RangeCorrected, CORRECTED)
    pipeline = ros.start("pipeline", *PLAY)
    ros.play()
    assert pipeline.wait() == 0, pipeline.output
    ros.spin_until(lambda: len(received) == 200)
    assert [m.sequence for m in received] == list(range(200))
    assert [m.range for m in received] == [np.float32(e.range_m) for e in expected]
    assert [m.variance for m in received] == [np.float32(e.variance_m2) for e in expected]
    assert "unknown" not in pipeline.output


def test_raw_ranges_are_published_for_subscribers(ros: Ros):
    raw = ros.collect(RangeCir, "/uwb/range_raw")
    corrected = ros.collect(RangeCorrected, CORRECTED)
    ros.start("pipeline", *PLAY)
    ros.play()
    ros.spin_until(lambda: len(raw) == 200 and len(corrected) == 200)
    assert [m.header for m in raw] == [m.header for m in corrected]
    assert [m.range for m in raw] == [m.range_raw for m in corrected]
    assert all(len(m.cir.samples) for m in raw)


def test_several_pipelines_do_not_interfere(ros: Ros):
    received = {name: ros.collect(RangeCorrected, f"/{name}{CORRECTED}") for name in ("left", "right")}
    pipelines = [ros.start("pipeline", *PLAY, arguments=("-r", f"__ns:=/{name}")) for name in received]
    for name in received:
        ros.play(f"{name}/driver")
    for pipeline in pipelines:
        assert pipeline.wait() == 0, pipeline.output
    ros.spin_until(lambda: all(len(messages) == 200 for messages in received.values()))
    for messages in received.values():
        assert [m.sequence for m in messages] == list(range(200))


@pytest.mark.parametrize("model", ["universal", "universal_amplitude", "evk1000_apartment", "dw3000_sts"])
def test_network_runs_before_the_mitigator_is_active(model: str, monkeypatch: pytest.MonkeyPatch):
    batches: list[int] = []
    predict_m = Session.predict_m
    monkeypatch.setattr(
        Session, "predict_m", lambda self, windows: batches.append(len(windows)) or predict_m(self, windows)
    )
    mitigator.load_corrector(model)
    assert {1, mitigator.BATCH} <= set(batches)
