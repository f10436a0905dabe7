"""The shipped universal models on the second simulator (`image_source_rooms`), which no model was trained or tuned on."""

from __future__ import annotations

import image_source_rooms
import numpy as np
import pytest

from uwb_mitigation.measurement import RangeColumns, Status
from uwb_mitigation.mitigation import Mitigation
from uwb_mitigation.model.bundle import load_bundle
from uwb_mitigation.model.shipped import default_model_path
from uwb_mitigation.preprocessing import Scaling

SEED, COUNT = 2027, 1000


@pytest.fixture(scope="module")
def models() -> dict[Scaling, Mitigation]:
    return {scaling: Mitigation(load_bundle(default_model_path(scaling))) for scaling in Scaling}


def ratio(model: Mitigation, columns: RangeColumns, error: np.ndarray, blocked: np.ndarray) -> float:
    """MAE over that of a constant offset; each less its own median in line of sight."""
    correction = np.zeros(len(error))
    rows, answers = model.correct_columns(columns)
    correction[rows] = np.where(answers.status == Status.OK, answers.correction_m, 0.0)
    left = error - correction
    mae = [np.abs(values - np.median(values[~blocked])).mean() for values in (left, error)]
    return float(mae[0] / mae[1])


@pytest.mark.parametrize("late", [0, 5, 10])
@pytest.mark.parametrize("scenario", image_source_rooms.SCENARIOS)
@pytest.mark.parametrize("scaling", Scaling)
def test_no_model_is_worse_than_a_constant_offset(scaling, scenario, late, models):
    columns, error, blocked = image_source_rooms.draw(scenario, COUNT, SEED)
    if late:
        columns = image_source_rooms.late(columns, late)
    if scaling is Scaling.MAX:
        columns = image_source_rooms.without_levels(columns)
    assert ratio(models[scaling], columns, error, blocked) <= 1.02
