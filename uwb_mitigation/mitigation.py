"""From a measurement to a corrected range: offset, preprocessing, prior, network, and what happens when one fails."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.measurement import (
    Cir,
    CorrectedColumns,
    CorrectedRange,
    Origin,
    RangeColumns,
    RangeMeasurement,
    Status,
)
from uwb_mitigation.model.bundle import Bundle, Card
from uwb_mitigation.model.familiarity import Strangeness, features
from uwb_mitigation.model.runtime import Session
from uwb_mitigation.offsets import NO_OFFSETS, Offsets

MAX_RANGE_M = 1e6
"""What lies beyond is no range: the radio reaches a few hundred metres."""

MIN_COLUMNS = 4
"""Fewer measurements with CIRs alike are faster one by one."""


class Grader:
    """How much of a predicted error a bundle's card lets through, and with what variance."""

    def __init__(self, card: Card) -> None:
        self._low, self._high = (np.float32(limit) for limit in card.correction_limits_m)
        self._variance = np.float32(card.variance_m2)
        self._variance_per_m2 = np.float32(card.variance_per_m2)
        self._variance_uncorrected = np.float32(card.variance_uncorrected_m2)
        familiarity = card.familiarity
        self._strangeness = None if familiarity is None else Strangeness(familiarity.bands)
        self._scaling = card.preprocessing.scaling
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
        values = features(windows, self._scaling, range_m, rx_power_dbm, first_path_power_dbm)
        return self._strangeness.score(values)

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


class Backend(Protocol):
    """What corrects ranges with a bundle: `Mitigation` by ONNX Runtime, `FirmwareMitigation` by the firmware's C.

    Attributes:
        offsets: of the radios; may be set between two ranges.
    """

    offsets: Offsets

    @property
    def bundle(self) -> Bundle:
        """What it corrects with."""

    def correct(self, measurement: RangeMeasurement) -> CorrectedRange:
        """The corrected range; never raises on what a measurement holds."""

    def correct_columns(self, ranges: RangeColumns) -> tuple[NDArray[np.intp], CorrectedColumns]:
        """The rows that it has answers for, ascending, and these: what `correct` says, to the bit.

        Every row with the status OK is among them. Ask `correct` for the others.
        """


def correct_batch(backend: Backend, measurements: Sequence[RangeMeasurement]) -> list[CorrectedRange]:
    """`correct` of each measurement, to the bit; those whose CIRs are alike at once, which is faster on many."""
    answers: list[CorrectedRange | None] = [None] * len(measurements)
    alike: dict[tuple[int, int], list[int]] = {}
    for index, measurement in enumerate(measurements):
        alike.setdefault((measurement.cir.encoding, len(measurement.cir.samples)), []).append(index)
    for indices in alike.values():
        if len(indices) < MIN_COLUMNS:
            continue
        rows, corrected = backend.correct_columns(RangeColumns.of([measurements[i] for i in indices]))
        values = (corrected.range_m, corrected.correction_m, corrected.variance_m2, corrected.status)
        for row, range_m, correction_m, variance_m2, status in zip(
            rows.tolist(), *(value.tolist() for value in values), strict=True
        ):
            measurement = measurements[indices[row]]
            if status != Status.OK:
                answers[indices[row]] = passed_through(
                    backend.bundle, measurement, Status(status), backend.offsets
                )
                continue
            answers[indices[row]] = CorrectedRange(
                range_m,
                measurement.range_m,
                correction_m,
                variance_m2,
                Status.OK,
                corrected.origin,
                corrected.model_id,
            )
    return [
        backend.correct(measurement) if answer is None else answer
        for measurement, answer in zip(measurements, answers, strict=True)
    ]


def passed_through(
    bundle: Bundle, measurement: RangeMeasurement, status: Status, offsets: Offsets = NO_OFFSETS
) -> CorrectedRange:
    """The raw range of a measurement whose error was not predicted, less its radios' offset, with the variance of one.

    The offset is known, whatever the CIR holds. A range without a CIR from which an offset was subtracted gets the
    variance of corrected ranges: that of uncorrected ranges contains the offsets of the training boards.
    """
    offset_m = offsets.of(measurement.tag_id, measurement.anchor_id)
    range_m = _less(measurement.range_m, offset_m)
    card = bundle.card
    is_calibrated = status is Status.NO_CIR and offset_m != 0.0
    variance_m2 = card.variance_m2 if is_calibrated else card.variance_uncorrected_m2
    return CorrectedRange(
        range_m=range_m,
        range_raw_m=measurement.range_m,
        correction_m=offset_m,
        variance_m2=variance_m2 if _valid(range_m) else math.inf,
        status=status,
        origin=Origin.HOST,
        model_id=bundle.model_id,
    )


class Mitigation:
    """Corrects ranges with one bundle, by ONNX Runtime. Not for use by two threads at once.

    Predicted error = prior + network, correction = offset of the radios + predicted error, and corrected = range -
    correction, each one float32 operation, so that a microcontroller gets the same bits. What the bundle sees of the
    range is the range less the offset. No measurement is refused: where one cannot be corrected its raw range passes
    through, less the offset, with a status that says why and a larger variance.

    The further a measurement lies outside of what the bundle was trained on (`familiarity`), the more its
    correction shrinks from the predicted error to the offset that the training data had on the whole, and
    the larger its variance is, status OK. Wholly outside, the raw range passes through.

    Attributes:
        offsets: of the radios, beside what the bundle predicts; may be set between two ranges.

    Raises:
        ModelError: ONNX Runtime refuses the bundle's network.
    """

    def __init__(self, bundle: Bundle, offsets: Offsets = NO_OFFSETS) -> None:
        self.bundle = bundle
        self.offsets = offsets
        self._session = Session(bundle)
        self._window = np.zeros(bundle.preprocessing.samples, np.float32)
        self._preprocessing = bundle.preprocessing
        self._prior = bundle.prior
        card = bundle.card
        self._variance_uncorrected = float(np.float32(card.variance_uncorrected_m2))
        self._grader = Grader(card)

    def correct(self, measurement: RangeMeasurement) -> CorrectedRange:
        """The corrected range; never raises on what a measurement holds.

        Status NO_CIR, BAD_CIR: see `CirFault`; a bundle that needs no CIR corrects these, too.
        OUT_OF_DISTRIBUTION: the range less offset is negative or not finite, the predicted error lies outside
        the bundle's limits, or the measurement is wholly unlike the bundle's training data. MODEL_ERROR: the
        network failed, or its output is not finite.
        """
        offset_m = self.offsets.of(measurement.tag_id, measurement.anchor_id)
        range_m = _less(measurement.range_m, offset_m)
        prior, status = self._prepare(range_m, measurement.cir)
        unread = status in (Status.NO_CIR, Status.BAD_CIR)
        if unread and not self.bundle.card.needs_cir and _valid(range_m):
            prior = self._prior.predict_m(*self._powers_alone(measurement.cir))
            if math.isfinite(prior):
                return self._corrected(measurement, np.float32(offset_m), prior, np.float32(0.0))
        if status is not Status.OK:
            return self._passed_through(measurement, status)
        try:
            predicted = self._session.predict_m(self._window)
        except Exception:  # Whatever ONNX Runtime raises, a consumer must still get its range.
            return self._passed_through(measurement, Status.MODEL_ERROR)
        score = self._score(range_m, measurement.cir)
        return self._corrected(measurement, np.float32(offset_m), prior + predicted, score)

    def correct_columns(self, ranges: RangeColumns) -> tuple[NDArray[np.intp], CorrectedColumns]:
        """As `Backend` says; the rows are those whose error could be predicted."""
        offset = self.offsets.of_columns(ranges.tag_id, ranges.anchor_id)
        raw = ranges.range_m
        powers = (ranges.rx_power_dbm, ranges.first_path_power_dbm)
        with np.errstate(over="ignore"):  # As in `_less`.
            range_m = np.where(offset == 0.0, raw, raw.astype(np.float32, copy=False) - offset)
        predicted = self._prior.predict_batch_m(*powers)
        score = np.zeros(len(raw), np.float32)
        read, windows = self._preprocessing.apply_batch(ranges)
        with_powers = np.isfinite(predicted[read])
        if not with_powers.all():
            read, windows = read[with_powers], windows[with_powers]
        unread = np.ones(len(raw), np.bool_)
        unread[read] = False
        predicted[unread] = np.nan
        if not self.bundle.card.needs_cir:
            predicted[unread] = self._prior.predict_batch_m(*self._powers_alone(ranges))[unread]
        try:
            predicted[read] += self._session.predict_batch_m(windows)
        except Exception:  # As in `correct`.
            predicted[read] = np.nan
        with np.errstate(over="ignore"):  # As in `_score`.
            judged = (values[read].astype(np.float32, copy=False) for values in (range_m, *powers))
            score[read] = self._grader.score(windows, *judged)

        rows = np.flatnonzero(np.isfinite(predicted) & (range_m >= 0.0) & (range_m <= MAX_RANGE_M))
        predicted, score = predicted[rows], score[rows]
        inside = self._grader.passes(predicted, score)
        correction = np.zeros(len(rows), np.float32)
        variance = np.full(len(rows), self._variance_uncorrected, np.float32)
        correction[inside], variance[inside] = self._grader.grade(predicted[inside], score[inside])
        correction += offset[rows]
        return rows, CorrectedColumns(
            raw[rows].astype(np.float32, copy=False) - correction,
            correction,
            variance,
            np.where(inside, np.uint8(Status.OK), np.uint8(Status.OUT_OF_DISTRIBUTION)),
            Origin.HOST,
            self.bundle.model_id,
        )

    def _passed_through(self, measurement: RangeMeasurement, status: Status) -> CorrectedRange:
        return passed_through(self.bundle, measurement, status, self.offsets)

    def _score(self, range_m: float, cir: Cir) -> np.float32:
        """The grader's score of a measurement whose input is in the window."""
        if not self._grader.judges:
            familiar: np.float32 = np.float32(0.0)
            return familiar
        with np.errstate(over="ignore"):  # a power beyond float32 is as strange as an infinite one
            numbers = np.array([[range_m], [cir.rx_power_dbm], [cir.first_path_power_dbm]], np.float32)
        score: np.float32 = self._grader.score(self._window[None], *numbers)[0]
        return score

    def _powers_alone(self, of: Cir | RangeColumns) -> tuple[Any, Any]:
        """The powers that the prior reads where it is alone; a level that it gives no weight need not be known."""
        first_path = of.first_path_power_dbm if self._prior.per_power_gap != 0.0 else of.rx_power_dbm
        return of.rx_power_dbm, first_path

    def _prepare(self, range_m: float, cir: Cir) -> tuple[np.float32, Status]:
        """Fill the network's input; return the prior's prediction and whether to go on."""
        prior = self._prior.predict_m(cir.rx_power_dbm, cir.first_path_power_dbm)
        fault = self._preprocessing.apply(cir, self._window)
        if fault is not None:
            return prior, fault.status
        if not _valid(range_m):
            return prior, Status.OUT_OF_DISTRIBUTION
        # The preprocessing does not see the powers: CirFault.NO_POWER is found here.
        if not math.isfinite(prior):
            return prior, Status.BAD_CIR
        return prior, Status.OK

    def _corrected(
        self, measurement: RangeMeasurement, offset: np.float32, predicted: np.float32, score: np.float32
    ) -> CorrectedRange:
        if not math.isfinite(predicted):
            return self._passed_through(measurement, Status.MODEL_ERROR)
        if not self._grader.passes(predicted, score):  # type: ignore[arg-type]
            return self._passed_through(measurement, Status.OUT_OF_DISTRIBUTION)
        graded, variance = self._grader.grade(predicted, score)  # type: ignore[arg-type]
        correction = offset + graded
        return CorrectedRange(
            range_m=float(np.float32(measurement.range_m) - correction),
            range_raw_m=measurement.range_m,
            correction_m=float(correction),
            variance_m2=float(variance),
            status=Status.OK,
            origin=Origin.HOST,
            model_id=self.bundle.model_id,
        )


def _less(range_m: float, offset_m: float) -> float:
    """A range less an offset, in float32 as boards have it; without an offset the range as it is."""
    if offset_m == 0.0:
        return range_m
    with np.errstate(over="ignore"):  # a range beyond float32 is none, as an infinite one is
        return float(np.float32(range_m) - np.float32(offset_m))


def _valid(range_m: float) -> bool:
    return 0.0 <= range_m <= MAX_RANGE_M
