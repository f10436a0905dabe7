"""From a measurement to a corrected range: preprocessing, prior, network, and what happens when one fails."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.measurement import (
    CorrectedColumns,
    CorrectedRange,
    Origin,
    RangeColumns,
    RangeMeasurement,
    Status,
)
from uwb_mitigation.model.bundle import Bundle, Card
from uwb_mitigation.model.familiarity import Strangeness, features
from uwb_mitigation.model.session import Session

MAX_RANGE_M = 1e6
"""What lies beyond is no range: the radio reaches a few hundred metres."""


class Grader:
    """How much of a predicted error a bundle's card lets through, and with what variance."""

    def __init__(self, card: Card) -> None:
        self._low, self._high = (np.float32(limit) for limit in card.correction_limits_m)
        self._variance = np.float32(card.variance_m2)
        self._variance_per_m2 = np.float32(card.variance_per_m2)
        self._variance_uncorrected = np.float32(card.variance_uncorrected_m2)
        familiarity = card.familiarity
        self._strangeness = None if familiarity is None else Strangeness(familiarity.bands)
        self._known_offset = np.float32(0.0 if familiarity is None else familiarity.known_offset_m)

    @property
    def judges(self) -> bool:
        """Whether the card says what is familiar."""
        return self._strangeness is not None

    def passes(self, predicted: NDArray[np.float32], score: NDArray[np.float32]) -> NDArray[np.bool_]:
        """Which predicted errors lie within the limits, at scores below 1; NaN does not. Also of scalars."""
        inside: NDArray[np.bool_] = (predicted >= self._low) & (predicted <= self._high) & (score < 1.0)
        return inside

    def score(
        self,
        windows: NDArray[np.float32],
        range_m: NDArray[np.float32],
        rx_power_dbm: NDArray[np.float32],
        first_path_power_dbm: NDArray[np.float32],
    ) -> NDArray[np.float32]:
        """How strange n measurements are to the bundle, float32 (n,); 0 where it does not say what is familiar."""
        if self._strangeness is None:
            return np.zeros(len(windows), np.float32)
        return self._strangeness.score(features(windows, range_m, rx_power_dbm, first_path_power_dbm))

    def grade(
        self, predicted: NDArray[np.float32], score: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Corrections and variances of predicted errors within the limits, at scores below 1; also of scalars."""
        correction: NDArray[np.float32] = predicted
        variance: NDArray[np.float32] = self._variance + self._variance_per_m2 * (predicted * predicted)
        if self._strangeness is not None:
            shrunk = self._known_offset + (np.float32(1.0) - score) * (predicted - self._known_offset)
            correction = np.where(score > 0.0, shrunk, predicted)
            variance = variance + np.maximum(score, np.float32(0.0)) * self._variance_uncorrected
        return correction, variance


class Mitigation:
    """Corrects ranges with one bundle. Not for use by two threads at once.

    Predicted error = prior + network, and corrected = range - predicted error, each one float32
    operation, so that a microcontroller gets the same bits. No measurement is refused: where one
    cannot be corrected its raw range passes through, with a status that says why and a larger variance.

    The further a measurement lies outside of what the bundle was trained on (`familiarity`), the more its
    correction shrinks from the predicted error to the offset that the training data had on the whole, and
    the larger its variance is, status OK. Wholly outside, the raw range passes through.

    Raises:
        ModelError: ONNX Runtime refuses the bundle's network.
    """

    def __init__(self, bundle: Bundle) -> None:
        self.bundle = bundle
        self._session = Session(bundle)
        self._window = np.zeros(bundle.preprocessing.samples, np.float32)
        self._preprocessing = bundle.preprocessing
        self._prior = bundle.prior
        card = bundle.card
        self._variance_uncorrected = float(np.float32(card.variance_uncorrected_m2))
        self._grader = Grader(card)

    def correct(self, measurement: RangeMeasurement) -> CorrectedRange:
        """The corrected range; never raises on what a measurement holds.

        Status NO_CIR, BAD_CIR: see `CirFault`. OUT_OF_DISTRIBUTION: the range is negative or not finite,
        the predicted error lies outside the bundle's limits, or the measurement is wholly unlike the
        bundle's training data. MODEL_ERROR: the network failed, or
        its output is not finite.
        """
        prior, status = self._prepare(measurement, self._window)
        if status is not Status.OK:
            return self._passed(measurement, status)
        try:
            predicted = self._session.predict_m(self._window)
        except Exception:  # Whatever ONNX Runtime raises, a consumer must still get its range.
            return self._passed(measurement, Status.MODEL_ERROR)
        score = self._scores([measurement], self._window[None])[0]
        return self._corrected(measurement, prior + predicted, score)

    def correct_batch(self, measurements: Sequence[RangeMeasurement]) -> list[CorrectedRange]:
        """`correct` of each measurement, to the bit; faster on many."""
        windows = np.zeros((len(measurements), self._preprocessing.samples), np.float32)
        prepared = [
            self._prepare(measurement, window)
            for measurement, window in zip(measurements, windows, strict=True)
        ]
        usable = [index for index, (_, status) in enumerate(prepared) if status is Status.OK]
        try:
            predicted = self._session.predict_batch_m(windows[usable])
        except Exception:  # As in `correct`.
            predicted = np.full(len(usable), np.nan, np.float32)
        scores = self._scores([measurements[index] for index in usable], windows[usable])
        judged = zip(predicted, scores, strict=True)
        results = []
        for measurement, (prior, status) in zip(measurements, prepared, strict=True):
            if status is Status.OK:
                network_m, score = next(judged)
                results.append(self._corrected(measurement, prior + network_m, score))
            else:
                results.append(self._passed(measurement, status))
        return results

    def correct_columns(self, ranges: RangeColumns) -> tuple[NDArray[np.intp], CorrectedColumns]:
        """The rows whose error could be predicted, ascending, and what `correct` makes of them, to the bit.

        Each has the status OK or OUT_OF_DISTRIBUTION. Ask `correct` for every other row.
        """
        rows, windows = self._preprocessing.apply_batch(ranges)
        prior = self._prior.predict_batch_m(ranges.rx_power_dbm[rows], ranges.first_path_power_dbm[rows])
        range_m = ranges.range_m[rows]
        wanted = np.isfinite(prior) & (range_m >= 0.0) & (range_m <= MAX_RANGE_M)
        try:
            predicted = prior + self._session.predict_batch_m(windows)
        except Exception:  # As in `correct`.
            wanted[:] = False
            predicted = prior
        wanted &= np.isfinite(predicted)
        if not wanted.all():
            rows, windows, predicted, range_m = (
                rows[wanted],
                windows[wanted],
                predicted[wanted],
                range_m[wanted],
            )
        score = self._grader.score(
            windows, range_m, ranges.rx_power_dbm[rows], ranges.first_path_power_dbm[rows]
        )
        inside = self._grader.passes(predicted, score)
        correction = np.zeros(len(rows), np.float32)
        variance = np.full(len(rows), self._variance_uncorrected, np.float32)
        correction[inside], variance[inside] = self._grader.grade(predicted[inside], score[inside])
        return rows, CorrectedColumns(
            range_m - correction,
            correction,
            variance,
            np.where(inside, np.uint8(Status.OK), np.uint8(Status.OUT_OF_DISTRIBUTION)),
            Origin.HOST,
            self.bundle.model_id,
        )

    def _scores(
        self, measurements: Sequence[RangeMeasurement], windows: NDArray[np.float32]
    ) -> NDArray[np.float32]:
        """The grader's scores of measurements whose inputs are `windows`."""
        if not self._grader.judges:
            return np.zeros(len(windows), np.float32)
        with np.errstate(over="ignore"):  # a power beyond float32 is as strange as an infinite one
            numbers = np.array(
                [(m.range_m, m.cir.rx_power_dbm, m.cir.first_path_power_dbm) for m in measurements],
                np.float32,
            ).reshape(-1, 3)
        return self._grader.score(windows, *numbers.T)

    def _prepare(
        self, measurement: RangeMeasurement, window: NDArray[np.float32]
    ) -> tuple[np.float32, Status]:
        """Fill the network's input; return the prior's prediction and whether to go on."""
        cir = measurement.cir
        prior = self._prior.predict_m(cir.rx_power_dbm, cir.first_path_power_dbm)
        fault = self._preprocessing.apply(cir, window)
        if fault is not None:
            return prior, fault.status
        if not _valid(measurement.range_m):
            return prior, Status.OUT_OF_DISTRIBUTION
        # The preprocessing does not see the powers: CirFault.NO_POWER is found here.
        if not math.isfinite(prior):
            return prior, Status.BAD_CIR
        return prior, Status.OK

    def _corrected(
        self, measurement: RangeMeasurement, predicted: np.float32, score: np.float32
    ) -> CorrectedRange:
        if not math.isfinite(predicted):
            return self._passed(measurement, Status.MODEL_ERROR)
        if not self._grader.passes(predicted, score):  # type: ignore[arg-type]
            return self._passed(measurement, Status.OUT_OF_DISTRIBUTION)
        correction, variance = self._grader.grade(predicted, score)  # type: ignore[arg-type]
        return CorrectedRange(
            range_m=float(np.float32(measurement.range_m) - correction),
            range_raw_m=measurement.range_m,
            correction_m=float(correction),
            variance_m2=float(variance),
            status=Status.OK,
            origin=Origin.HOST,
            model_id=self.bundle.model_id,
        )

    def _passed(self, measurement: RangeMeasurement, status: Status) -> CorrectedRange:
        valid = _valid(measurement.range_m)
        return CorrectedRange(
            range_m=measurement.range_m,
            range_raw_m=measurement.range_m,
            correction_m=0.0,
            variance_m2=self._variance_uncorrected if valid else math.inf,
            status=status,
            origin=Origin.HOST,
            model_id=self.bundle.model_id,
        )


def _valid(range_m: float) -> bool:
    return 0.0 <= range_m <= MAX_RANGE_M
