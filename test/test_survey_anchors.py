"""Anchor positions estimated from a drive."""

from dataclasses import replace

import numpy as np
import pytest
from drives import HALL, anchors_at, circuit, drive

from uwb_mitigation.calibration.survey import displacements, survey_anchors
from uwb_mitigation.errors import DatasetError
from uwb_mitigation.positioning.config import EstimatorConfig
from uwb_mitigation.positioning.geometry import Area, Height
from uwb_mitigation.types.anchors import SD_M

LEVEL = Height(1.0)


@pytest.fixture(scope="module")
def minute():
    return drive(seconds=60, rate_hz=10.0)[0]


def test_anchors_are_estimated_from_guesses_with_errors_of_1_5_m(minute):
    rng = np.random.default_rng(5)
    away = np.zeros((5, 3))
    away[:, :2] = rng.normal(0, 1, (5, 2))
    away *= 1.5 / np.linalg.norm(away, axis=1, keepdims=True)
    found = survey_anchors(
        EstimatorConfig(HALL.moved(HALL.position + away, HALL.sd), height=LEVEL), minute, off_m=1.5
    )
    off = displacements(found.anchors.position, HALL.position)
    assert np.sqrt((off**2).sum(axis=1).mean()) < 0.15
    assert found.swapped == []
    assert found.explained


def test_anchors_that_contradict_the_ranges_are_reported(minute):
    shuffled = minute.take(slice(0, 300))
    shuffled = replace(shuffled, range_m=np.random.default_rng(1).permutation(shuffled.range_m))
    assert not survey_anchors(EstimatorConfig(HALL, height=LEVEL), shuffled).explained


MOVED = HALL.position + np.outer(np.arange(5) == 2, (0.4, 0.3, 0.0))


@pytest.mark.parametrize(
    ("position", "misplaced", "swapped"),
    [(HALL.position, [], []), (MOVED, [2], []), (HALL.position[[0, 3, 2, 1, 4]], [1, 3], [(1, 3)])],
)
def test_only_anchors_at_wrong_positions_are_named(minute, position, misplaced, swapped):
    found = survey_anchors(EstimatorConfig(HALL.moved(position, HALL.sd), height=LEVEL), minute)
    assert (sorted(found.misplaced), found.swapped) == (misplaced, swapped)


def test_mirror_image_of_a_square_is_not_a_swapped_pair():
    """Swapped opposite anchors of a square are its mirror image, which explains the ranges as well as the truth."""
    square = anchors_at([(2, 0, 2), (10, 0, 2), (10, 8, 2), (2, 8, 2)], SD_M)
    ranges, _ = drive(square, seconds=40, rate_hz=10.0, seed=2)
    guesses = square.position + np.random.default_rng(3).normal(0, (0.4, 0.4, 0), (4, 3))
    found = survey_anchors(EstimatorConfig(square.moved(guesses, square.sd), height=LEVEL), ranges, off_m=0.4)
    assert found.explained
    assert found.swapped == []


@pytest.mark.parametrize(("guess_sd_m", "mirrored"), [(0.1, False), (0.7, True)])
def test_mirror_image_that_fits_the_guesses_as_well_is_reported(guess_sd_m: float, mirrored: bool):
    narrow = anchors_at([(4.0 * i - 4.0, 0.4 * (-1) ** i, 2.0) for i in range(1, 5)], SD_M)
    ranges, _ = drive(narrow, seconds=20, seed=2)
    wrong = narrow.position + np.random.default_rng(4).normal(0, (guess_sd_m, guess_sd_m, 0), (4, 3))
    area = Area((-5, 1, 0), (20, 20, 3))
    found = survey_anchors(EstimatorConfig(narrow.moved(wrong, narrow.sd), height=LEVEL, area=area), ranges)
    assert found.explained
    assert found.mirrored is mirrored


def test_unobservable_directions_are_reported():
    guesses = HALL.moved(HALL.position, np.full(5, 0.5))
    level_drive = drive(seconds=60, rate_hz=20.0)[0]
    level_drive = level_drive.take(slice(0, 600))
    found = survey_anchors(EstimatorConfig(guesses), level_drive, off_m=0.5)
    assert found.undetermined == [0, 1, 2, 3, 4]
    assert {0, 2} <= set(found.alternatives)
    assert not survey_anchors(EstimatorConfig(HALL), level_drive, off_m=0.05).undetermined


def test_recording_that_cannot_be_surveyed_is_refused(minute):
    still, _ = drive(seconds=10, path=lambda t: circuit(0 * t))
    for anchors, ranges, message in (
        (HALL, minute.take(minute.anchor < 2), "2 anchors were received"),
        (HALL.moved(HALL.position * (1, 0, 0), HALL.sd), minute, "on a line"),
        (HALL, still, "the tag moves by"),
    ):
        with pytest.raises(DatasetError, match=message):
            survey_anchors(EstimatorConfig(anchors, height=LEVEL), ranges)
