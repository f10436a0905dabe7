"""A model on the board and the same on the host: the same bits, through the wire and back."""

from __future__ import annotations

import struct
from itertools import islice
from pathlib import Path

import pytest

from uwb_mitigation.link import messages
from uwb_mitigation.link.board import Board, Identity
from uwb_mitigation.link.layout import Mode
from uwb_mitigation.link.messages import Correction
from uwb_mitigation.link.session import BoardSession
from uwb_mitigation.measurement import CorrectedRange, RangeMeasurement
from uwb_mitigation.mitigation import Mitigation
from uwb_mitigation.model.bundle import load_bundle
from uwb_mitigation.sources.simulated import SimulatedSource

MODEL = Path(__file__).parent.parent / "models" / "evk1000_apartment.onnx"


@pytest.fixture(scope="module")
def mitigation() -> Mitigation:
    if not MODEL.exists():
        pytest.skip(f"no model at {MODEL}")
    return Mitigation(load_bundle(MODEL))


def bits(corrected: CorrectedRange) -> tuple[object, ...]:
    floats = (corrected.range_m, corrected.range_raw_m, corrected.correction_m, corrected.variance_m2)
    return struct.pack("<4f", *floats), corrected.status, corrected.model_id


def connect(mitigation: Mitigation, mode: Mode) -> tuple[BoardSession, Board]:
    session = BoardSession(expected_model_id=mitigation.bundle.model_id)
    board = Board(Identity(model_id=mitigation.bundle.model_id), mitigation, mode=mode)
    session.receive(board.hello(0), 0, 0)
    session.outgoing()
    return session, board


def recorded(count: int) -> list[RangeMeasurement]:
    return [record.measurement for record in islice(SimulatedSource(seed=3), count)]


def test_what_the_board_corrects_equals_the_hosts_correction_of_what_the_board_sent(mitigation):
    session, board = connect(mitigation, Mode.DEVICE)
    for now, measurement in enumerate(recorded(50)):
        raw = messages.decode(*messages.encode(measurement))
        (corrected,) = session.receive(board.measure(measurement, now), 0, 0)
        assert isinstance(raw, RangeMeasurement)
        assert isinstance(corrected, Correction)
        assert bits(corrected.corrected) == bits(mitigation.correct([raw])[0])
