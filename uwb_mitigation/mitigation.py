"""From a measurement to a corrected range: preprocessing, prior, network, and what happens when one fails."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.measurement import CorrectedRange, Origin, RangeColumns, RangeMeasurement, Status
from uwb_mitigation.model.bundle import Bundle
from uwb_mitigation.model.session import Session

MAX_RANGE_M = 1e6
"""What lies beyond is no range: the radio reaches a few hundred metres."""


class Mitigation:
    """Corrects ranges with one bundle. Not for use by two threads at once.

    Predicted error = prior + network, and corrected = range - predicted error, each one float32
    operation, so that a microcontroller gets the same bits. No measurement is refused: where one
    cannot be corrected its raw range passes through, with a status that says why and a larger variance.

    Raises:
        ModelError: ONNX Runtime refuses the bundle's network.
    """

    def __init__(self, bundle: Bundle) -> None:
        self.bundle = bundle
        self._session = Session(bundle)
        self._window = np.zeros(bundle.preprocessing.samples, np.float32)
        self._preprocessing = bundle.preprocessing
        self._prior = bundle.prior
        self._low, self._high = bundle.card.correction_limits_m
        self._variance = bundle.card.variance_m2
        self._variance_uncorrected = bundle.card.variance_uncorrected_m2

    def correct(self, measurement: RangeMeasurement) -> CorrectedRange:
        """The corrected range; never raises on what a measurement holds.

        Status NO_CIR, BAD_CIR: see `CirFault`. OUT_OF_DISTRIBUTION: the range is negative or not finite,
        or the predicted error lies outside the bundle's limits. MODEL_ERROR: the network failed, or
        its output is not finite.
        """
        prior, status = self._prepare(measurement, self._window)
        if status is not Status.OK:
            return self._passed(measurement, status)
        try:
            predicted = self._session.predict_m(self._window)
        except Exception:  # Whatever ONNX Runtime raises, a consumer must still get its range.
            return self._passed(measurement, Status.MODEL_ERROR)
        return self._corrected(measurement, prior + predicted)

    def correct_batch(self, measurements: Sequence[RangeMeasurement]) -> list[CorrectedRange]:
        """`correct` of each measurement, to the bit; faster on many."""
        windows = np.zeros((len(measurements), self._preprocessing.samples), np.float32)
        prepared = [
            self._prepare(measurement, window)
            for measurement, window in zip(measurements, windows, strict=True)
        ]
        usable = [index for index, (_, status) in enumerate(prepared) if status is Status.OK]
        predicted: NDArray[np.float32] | None = None
        if usable:
            try:
                predicted = self._session.predict_batch_m(windows[usable])
            except Exception:  # As in `correct`.
                predicted = None
        results = []
        outputs = iter(()) if predicted is None else iter(predicted)
        for measurement, (prior, status) in zip(measurements, prepared, strict=True):
            if status is not Status.OK:
                results.append(self._passed(measurement, status))
            elif predicted is None:
                results.append(self._passed(measurement, Status.MODEL_ERROR))
            else:
                results.append(self._corrected(measurement, prior + next(outputs)))
        return results

    def correct_columns(
        self, ranges: RangeColumns
    ) -> tuple[NDArray[np.intp], NDArray[np.float32], NDArray[np.float32]]:
        """The rows that `correct` gives status OK, ascending; their ranges and corrections, m, to the bit.

        Every other row passes through: ask `correct` for its status.
        """
        rows, windows = self._preprocessing.apply_batch(ranges)
        prior = self._prior.predict_batch_m(ranges.rx_power_dbm[rows], ranges.first_path_power_dbm[rows])
        range_m = ranges.range_m[rows]
        wanted = np.isfinite(prior) & (range_m >= 0.0) & (range_m <= MAX_RANGE_M)
        if not wanted.all():
            rows, windows, prior, range_m = rows[wanted], windows[wanted], prior[wanted], range_m[wanted]
        if not len(rows):
            return rows, range_m, prior
        try:
            predicted = prior + self._session.predict_batch_m(windows)
        except Exception:  # As in `correct`.
            return rows[:0], range_m[:0], prior[:0]
        # NaN is inside of no limits.
        inside = (predicted >= np.float32(self._low)) & (predicted <= np.float32(self._high))
        rows, range_m, predicted = rows[inside], range_m[inside], predicted[inside]
        return rows, range_m - predicted, predicted

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

    def _corrected(self, measurement: RangeMeasurement, predicted: np.float32) -> CorrectedRange:
        if not math.isfinite(predicted):
            return self._passed(measurement, Status.MODEL_ERROR)
        if not self._low <= predicted <= self._high:
            return self._passed(measurement, Status.OUT_OF_DISTRIBUTION)
        return CorrectedRange(
            range_m=float(np.float32(measurement.range_m) - predicted),
            range_raw_m=measurement.range_m,
            correction_m=float(predicted),
            variance_m2=self._variance,
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
