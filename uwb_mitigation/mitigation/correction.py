"""Correction of ranges: offset, preprocessing, linear bias model, network, and the handling of failures."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import lru_cache, partial
from itertools import islice
from typing import Any, Protocol, overload

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.errors import ModelError, ParameterError, UwbMitigationError
from uwb_mitigation.mitigation.arrays import columns_of_arrays
from uwb_mitigation.mitigation.at_rest import PairsAtRest
from uwb_mitigation.mitigation.early_path import MIN_RANGE_M, find_early_paths
from uwb_mitigation.mitigation.model.bundle import Bundle, ModelCard, Session
from uwb_mitigation.mitigation.model.choice import Choice, CirKind, choose_model, kinds_of
from uwb_mitigation.mitigation.model.ood import OodDetector, approximate_features, ood_features
from uwb_mitigation.types.measurement import (
    CORRECTED,
    CirFault,
    CorrectedBy,
    CorrectedColumns,
    CorrectedRange,
    RangeColumns,
    RangeMeasurement,
    Record,
    Status,
    reason,
)
from uwb_mitigation.types.offsets import NO_OFFSETS, AnyOffsets, as_offsets

MAX_RANGE_M = 1e6
"""Upper limit of valid ranges: the radio reaches a few hundred metres."""

UNRELIABLE_VARIANCE_M2 = 0.25
"""A corrected range with a larger variance is UNRELIABLE. At simulated sites these are 10 % of the ranges, and half of those
with an error of more than 0.5 m."""

OTHER_CHANNEL_FACTOR = 2.0
"""Factor of the standard deviation on a known channel for which the model was not trained. Simulated, channels 4 and 7 need 1.4 to 2.5,
depending on the width of the pulse (docs/experiments/other_channels.py)."""

CLEARLY_IN_DISTRIBUTION = -0.01
"""OOD score below which rounding decides nothing: all scores below 0 have the same result."""

BATCH = 256
"""Number of records that `Corrector.correct_records` reads ahead."""

MAX_KINDS = 1000
"""Number of kinds of CIRs whose models are kept."""

_COLUMNS = ("range_m", "correction_m", "variance_m2", "status", "model_id", "fault")
_STATUSES = {int(status): status for status in Status}
# NumPy takes microseconds to convert a member of an enumeration.
_INFINITE_VARIANCE = np.float32(np.inf)
_ALL_ROWS = slice(None)
_OK, _NO_CIR, _BAD_CIR, _OUT_OF_DISTRIBUTION, _MODEL_ERROR, _UNRELIABLE = _STATUSES


class CorrectionRule:
    """Computes corrections and variances from predicted errors, as the card of a bundle specifies."""

    def __init__(self, card: ModelCard) -> None:
        self._low, self._high = card.correction_limits_m
        lines = card.scale_lines
        self._begins, self._lines = lines[1:, 0].copy(), lines[:, 1:].copy()
        self._variance_uncorrected = np.float32(card.variance_uncorrected_m2)
        ood_bands = card.ood_bands
        self._ood_detector = None if ood_bands is None else OodDetector(ood_bands.bands)
        self._scaling = card.preprocessing.scaling
        self._known_offset = np.float32(0.0 if ood_bands is None else ood_bands.known_offset_m)

    def accepts(self, predicted: NDArray[np.float32], score: NDArray[np.float32]) -> list[bool]:
        """Return which predicted errors are within the limits and have an OOD score below 1."""
        low, high = self._low, self._high
        pairs = zip(predicted.tolist(), score.tolist(), strict=True)
        return [low <= error_m <= high and value < 1.0 for error_m, value in pairs]

    def score(self, windows: NDArray[np.float32], *reported: NDArray[np.floating]) -> NDArray[np.float32]:
        """Return the OOD score of n measurements, float32 (n,); 0 if the card has no bands. Arguments: see `ood_features`."""
        if self._ood_detector is None:
            return np.zeros(len(windows), np.float32)
        if len(windows) == 1:
            numbers = (float(values[0]) for values in reported)
            score = self._ood_detector.score(approximate_features(windows[0], self._scaling, *numbers))
            if score < CLEARLY_IN_DISTRIBUTION:
                return np.array([score], np.float32)
        return np.asarray(
            self._ood_detector.score(ood_features(windows, self._scaling, *reported)), np.float32
        )

    def apply(
        self, predicted: NDArray[np.float32], score: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return corrections (m) and variances (m^2) of predicted errors that `accepts` accepts, float32 (n,)."""
        correction: NDArray[np.float32] = predicted
        size = np.abs(predicted)
        lines = self._lines[self._begins.searchsorted(size, "right")]
        deviation = lines[:, 0] + lines[:, 1] * size
        variance: NDArray[np.float32] = deviation * deviation
        if self._ood_detector is not None and np.count_nonzero(score > 0.0):
            shrunk = self._known_offset + (np.float32(1.0) - score) * (predicted - self._known_offset)
            correction = np.where(score > 0.0, shrunk, predicted)
            variance = variance + np.maximum(score, np.float32(0.0)) * self._variance_uncorrected
        return correction, variance


class Backend(Protocol):
    """Corrects ranges of a radio and a segment for which its model was trained."""

    def correct(self, ranges: RangeColumns, offset_m: NDArray[np.float32]) -> CorrectedColumns:
        """Return n corrected ranges; `offset_m`: offsets of their radios, m, float32 (n,)."""


class Corrector:
    """Corrects ranges: `Mitigation` with ONNX Runtime, `FirmwareMitigation` with the firmware's C.

    Arguments, attributes and errors are those of `Mitigation`.
    """

    _backend: Callable[[Bundle], Backend]

    def __init__(self, model: Bundle | Sequence[Bundle], offsets: AnyOffsets = NO_OFFSETS) -> None:
        self.bundles = tuple(model) if isinstance(model, Sequence) else (model,)
        if not self.bundles or not all(isinstance(bundle, Bundle) for bundle in self.bundles):
            raise ModelError(f"model {model!r:.60}", valid="what load_model() returns")
        self.offsets = as_offsets(offsets)
        self.bundle = self.bundles[0]
        self._backends = [self._backend(bundle) for bundle in self.bundles]
        self.used: Counter[Choice] = Counter()
        # Bounded, because a stream may contain CIRs of any length.
        self.choose = lru_cache(MAX_KINDS)(partial(choose_model, self.bundles))

    def __reduce__(self) -> tuple[Any, ...]:
        # Sessions cannot be pickled. They are made again, and `used` begins at 0.
        return type(self), (self.bundles, self.offsets)

    def correct_columns(self, ranges: RangeColumns) -> CorrectedColumns:
        """Return the corrected ranges; never raises because of the content of a measurement."""
        offset_m = self.offsets.lookup(ranges.tag_id, ranges.anchor_id)
        kinds = kinds_of(ranges)
        # A range or an energy beyond float32 is out of distribution, as an infinite one is.
        with np.errstate(over="ignore", invalid="ignore"):
            if len(kinds) == 1:
                return self._correct_kind(next(iter(kinds)), ranges, offset_m)
            # All rows are replaced.
            result = pass_through(self.bundle, ranges, offset_m.copy(), np.zeros(len(ranges), np.uint8))
            for kind, rows in kinds.items():
                of_kind = self._correct_kind(kind, ranges.take(rows), offset_m[rows])
                for name in _COLUMNS:
                    getattr(result, name)[rows] = getattr(of_kind, name)
        return result

    def _correct_kind(
        self, kind: CirKind, ranges: RangeColumns, offset_m: NDArray[np.float32]
    ) -> CorrectedColumns:
        choice = self.choose(kind)
        self.used[choice] += len(ranges)
        if choice.is_trained:
            corrected = self._backends[choice.model].correct(ranges, offset_m)
            if not (choice.fits or kind.has_levels):
                is_unlike = (corrected.status == _OUT_OF_DISTRIBUTION) & (corrected.fault == 0)
                corrected.fault[is_unlike] = CirFault.NO_POWER
            channels = self.bundles[choice.model].card.channels
            if ranges.channel and channels and ranges.channel not in channels:
                _widen(corrected)
            return corrected
        status = np.full(len(ranges), _OUT_OF_DISTRIBUTION if kind.samples else _NO_CIR, np.uint8)
        return pass_through(self.bundles[choice.model], ranges, offset_m, status)

    @overload
    def correct(self, measurements: RangeMeasurement) -> CorrectedRange: ...

    @overload
    def correct(self, measurements: Sequence[RangeMeasurement]) -> list[CorrectedRange]: ...

    def correct(
        self, measurements: RangeMeasurement | Sequence[RangeMeasurement]
    ) -> CorrectedRange | list[CorrectedRange]:
        """Return the corrected range of a measurement, or of each one; never raises because of their content.

        Measurements whose CIRs have the same encoding and length are corrected in one batch.

        Raises:
            ParameterError: other objects than measurements.
        """
        if isinstance(measurements, RangeMeasurement):
            return self.correct([measurements])[0]
        try:
            results: list[CorrectedRange | None] = [None] * len(measurements)
            groups = list(RangeColumns.grouped(measurements))
        except (AttributeError, TypeError) as error:
            what = f"{measurements!r:.60} has other values than a RangeMeasurement"
            raise ParameterError(what, valid="record.measurement, or a list of them") from error
        for indices, ranges in groups:
            corrected = self.correct_columns(ranges)
            columns = [getattr(corrected, name).tolist() for name in _COLUMNS]
            for index, range_m, correction_m, variance_m2, status, model_id, fault in zip(
                indices, *columns, strict=True
            ):
                range_raw_m = measurements[index].range_m
                results[index] = CorrectedRange(
                    range_m,
                    range_raw_m,
                    correction_m,
                    variance_m2,
                    _STATUSES[status],
                    corrected.origin,
                    model_id,
                    reason(status, fault, range_raw_m, correction_m) if status else "",
                )
        return [result for result in results if result is not None]

    def correct_records(self, records: Iterable[Record]) -> Iterator[tuple[Record, CorrectedRange]]:
        """Yield each record of a recording with its corrected range.

        `BATCH` records are read ahead, because a batch is faster: with live measurements, use `correct`.

        Raises:
            RecordingError: from `records`, after everything before the error has been yielded.
        """
        stream = iter(records)
        error: UwbMitigationError | None = None
        while error is None:
            batch: list[Record] = []
            try:
                batch.extend(islice(stream, BATCH))
            except UwbMitigationError as problem:
                error = problem
            if not batch:
                break
            yield from zip(batch, self.correct([record.measurement for record in batch]), strict=True)
        if error is not None:
            raise error

    def correct_arrays(
        self, range_m: Any, cir: Any, first_path_index: Any, **fields: Any
    ) -> CorrectedColumns:
        """Return n corrected ranges as arrays: `range_m` and `variance_m2` in metres and m^2, `status` as numbers, `reason`.

        The rows are corrected in batches, which bounds the memory.

        Args:
            range_m: float (n,), measured ranges.
            cir: complex (n, m), accumulator samples; or real (n, m), their magnitudes. Integers of 16 bits remain unchanged;
                other values are rounded to 1/30,000 of the largest sample of the range.
            first_path_index: float (n,), index of the first path, sub-sample; NaN = unknown.
            **fields: numbers, or arrays (n,): `start_index`, index of the first sample of `cir` (default: 0); `preamble_count`, accumulated symbols (0 = unknown); `rx_power_dbm` and
                `first_path_power_dbm`, levels (NaN = unknown); `tag_id` and `anchor_id`, integers that select offsets.
                For all CIRs: `radio` and `segment`.

        Raises:
            ParameterError: the shapes are inconsistent, all magnitudes are negative, most are in dB, most ranges are longer
                than a radio reaches, all first paths are outside of the CIRs, or a field is unknown.
        """
        chunks = columns_of_arrays(range_m, cir, first_path_index, **fields)
        return CorrectedColumns.joined([self.correct_columns(chunk) for chunk in chunks])


def pass_through(
    bundle: Bundle,
    ranges: RangeColumns,
    offset_m: NDArray[np.float32],
    status: NDArray[np.uint8],
    fault: NDArray[np.uint8] | None = None,
) -> CorrectedColumns:
    """Return the raw ranges minus the offsets of their radios, with the variance of uncorrected ranges.

    Without a CIR, nothing shows whether the direct path was lost: the standard deviation is at least half a metre, as of an
    UNRELIABLE range, whether the offset is known or not. The root mean square error of such real ranges is 0.24 to 0.93 m
    outdoors and 0.16 m in a labyrinth (`test_variance_of_ranges_without_cir_is_that_of_real_errors`).

    Args:
        bundle: the model.
        ranges: n measured ranges.
        offset_m: offset of the radios of each range, m, float32 (n,).
        status: `Status` of each range, uint8 (n,).
        fault: `CirFault` of each range, uint8 (n,), 0 = none; None: of none.

    Returns:
        n ranges; `status` and `fault` are not copied.
    """
    card = bundle.card
    range_m = _subtract_offset(ranges.range_m, offset_m).copy()
    variance = np.where(
        _is_valid_range(range_m), np.float32(card.variance_uncorrected_m2), _INFINITE_VARIANCE
    )
    if not ranges.samples.shape[1]:
        variance[status == _NO_CIR] = np.maximum(variance[status == _NO_CIR], UNRELIABLE_VARIANCE_M2)
    model_id = np.array([bundle.model_id] * len(ranges), np.uint32)
    if fault is None:
        fault = np.zeros(len(ranges), np.uint8)
    return CorrectedColumns(range_m, offset_m, variance, status, CorrectedBy.HOST, model_id, fault)


class OnnxBackend:
    """Runs a model with ONNX Runtime; `pairs_at_rest`: None = each range is corrected by itself."""

    def __init__(self, bundle: Bundle, pairs_at_rest: PairsAtRest | None = None) -> None:
        self.bundle = bundle
        self._session = Session(bundle)
        self._rule, self._pairs_at_rest = CorrectionRule(bundle.card), pairs_at_rest

    def correct(self, ranges: RangeColumns, offset_m: NDArray[np.float32]) -> CorrectedColumns:
        """See `Backend`."""
        # For a live range, a batch of one, loops over Python numbers are faster than operations on arrays.
        linear_bias, n = self.bundle.card.linear_bias, len(ranges)
        range_m = _subtract_offset(ranges.range_m, offset_m)
        powers = (ranges.rx_power_dbm, ranges.first_path_power_dbm)
        predicted = linear_bias.predict_m(*powers)
        faults, windows = self.bundle.card.preprocessing.apply(ranges)
        status = np.zeros(n, np.uint8)
        numbers = zip(faults.tolist(), predicted.tolist(), range_m.tolist(), strict=True)
        if all(not fault and bias == bias and 0.0 <= value <= MAX_RANGE_M for fault, bias, value in numbers):
            predicted, score = self._predict(ranges, _ALL_ROWS, range_m, windows, predicted)
        else:
            has_bias, valid, score = np.isfinite(predicted), _is_valid_range(range_m), np.zeros(n, np.float32)
            # CirFault.NO_POWER, which the preprocessing does not check
            status[~has_bias] = _BAD_CIR
            status[~valid] = _OUT_OF_DISTRIBUTION
            status[faults != 0] = _BAD_CIR if ranges.samples.shape[1] else _NO_CIR
            rows, bias_only = status == _OK, predicted
            predicted = np.full(n, np.nan, np.float32)
            if rows.any():
                windows = windows[rows[faults == 0]]
                predicted[rows], score[rows] = self._predict(ranges, rows, range_m, windows, bias_only)
            if not self.bundle.card.needs_cir:
                if linear_bias.per_power_gap == 0.0:  # The first-path power may be unknown.
                    bias_only = linear_bias.predict_m(powers[0], powers[0])
                uses_bias_only = valid & ~rows & np.isfinite(bias_only)
                predicted[uses_bias_only], status[uses_bias_only] = bias_only[uses_bias_only], _OK

        is_accepted = self._rule.accepts(predicted, score)
        accepted = _ALL_ROWS if all(is_accepted) else np.array(is_accepted)
        excess, variance = self._rule.apply(predicted[accepted], score[accepted])
        correction = offset_m[accepted] + excess
        corrected_m = ranges.range_m[accepted].astype(np.float32, copy=False) - correction
        is_kept = [value >= 0.0 for value in corrected_m.tolist()]
        if not all(is_kept):
            accepted = np.array(is_accepted)
            accepted[accepted] = is_kept
            corrected_m, correction, variance = (
                values[is_kept] for values in (corrected_m, correction, variance)
            )
        status[accepted] = [
            _UNRELIABLE if value > UNRELIABLE_VARIANCE_M2 else _OK for value in variance.tolist()
        ]
        if accepted is _ALL_ROWS:
            model_id = np.array([self.bundle.model_id] * n, np.uint32)
            return CorrectedColumns(
                corrected_m, correction, variance, status, CorrectedBy.HOST, model_id, faults
            )
        rejected = status == _OK
        rejected[accepted] = False
        status[rejected] = np.where(np.isfinite(predicted[rejected]), _OUT_OF_DISTRIBUTION, _MODEL_ERROR)
        corrected = pass_through(self.bundle, ranges, offset_m, status, faults)
        corrected.range_m[accepted] = corrected_m
        corrected.correction_m[accepted] = correction
        corrected.variance_m2[accepted] = variance
        return corrected

    def _predict(
        self,
        ranges: RangeColumns,
        rows: slice | NDArray[np.bool_],
        range_m: NDArray[np.floating],
        windows: NDArray[np.float32],
        bias_m: NDArray[np.float32],
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return predicted errors (m) and OOD scores of the m ranges in `rows`, float32 (m,).

        Args:
            ranges: n measured ranges.
            rows: those with a window, bool (n,) or all.
            range_m: their ranges minus offsets, m, (n,).
            windows: inputs of the network, (m, K).
            bias_m: linear biases, m, (n,).
        """
        range_m, bias_m = range_m[rows], bias_m[rows]
        powers = ranges.rx_power_dbm[rows], ranges.first_path_power_dbm[rows]
        try:
            network_m = self._session.predict_m(windows)
        except Exception:  # After any error of ONNX Runtime, consumers must still receive the range.
            return np.full(len(windows), np.nan, np.float32), np.zeros(len(windows), np.float32)
        if self.bundle.card.early_path:
            early_m = find_early_paths(ranges, rows, self.bundle.card.preprocessing.samples)
            for index, error_m in early_m.items():
                if (np.float32(range_m[index]) - bias_m[index]) - error_m >= MIN_RANGE_M:
                    network_m[index] = error_m
        predicted = bias_m + network_m
        score = self._rule.score(windows, range_m, *powers)
        if self._pairs_at_rest is not None:
            ids = ranges.tag_id[rows], ranges.anchor_id[rows]
            scaling = self.bundle.card.preprocessing.scaling
            self._pairs_at_rest.apply(ids, range_m, windows, scaling, predicted)
        return predicted, score


class Mitigation(Corrector):
    """Corrects ranges by ONNX Runtime. Not thread-safe.

    Predicted error = linear bias + network (or a missed direct path, see `early_path`), correction = offset of the radios + predicted error, and corrected = range -
    correction, each one float32 operation, so that a microcontroller computes the same bits. The model uses the range
    minus the offset. A corrected range whose variance exceeds `UNRELIABLE_VARIANCE_M2` is UNRELIABLE. No measurement is
    rejected: if a range cannot be corrected, the raw range minus the offset is passed through with a status that gives the
    reason and a larger variance:

    NO_CIR, BAD_CIR: see `CirFault`; a bundle that needs no CIR corrects these, too. OUT_OF_DISTRIBUTION: no model was
    trained for this radio or segment, the range minus offset or the corrected range is negative or not finite, the
    predicted error is outside the model's limits, or the OOD score is 1 or more. MODEL_ERROR: the network failed, or its output is not finite.

    On a known UWB channel that is not in `ModelCard.channels`, the standard deviation is multiplied by `OTHER_CHANNEL_FACTOR`.

    The further a measurement is outside the model's training data (`Card.ood_bands`), the more its correction shrinks
    from the predicted error to the overall offset of the training data, and the larger its variance is.

    Args:
        model: the model, or several, of which `choose_model` selects one for each range.
        offsets: offsets of the radios, in addition to the prediction of the model: one offset in m for all, `Offsets`, a
            file written by `uwb-mitigation offset` or `calibrate`, or a dictionary like it: `{"anchors": {1: 0.21}}`.
        median_at_rest: replace predicted errors by their median while a pair of radios is at rest (`PairsAtRest`). The result
            then depends on the ranges before, which must be in the order of time.

    Attributes:
        bundles: the models. bundle: the first one.
        offsets: offsets of the radios; may be changed between two calls.
        used: number of corrected ranges by choice of the model. choose: returns the `Choice` for a `CirKind`.

    Raises:
        ModelError: the backend rejects a model, or `model` is none.
        ParameterError: the offset is not finite, too large, or no such file exists.

    It can be pickled, for process pools; the copy has not seen earlier ranges.
    """

    def __init__(
        self,
        model: Bundle | Sequence[Bundle],
        offsets: AnyOffsets = NO_OFFSETS,
        *,
        median_at_rest: bool = False,
    ) -> None:
        self._median_at_rest = median_at_rest
        super().__init__(model, offsets)

    def __reduce__(self) -> tuple[Any, ...]:
        return partial(Mitigation, median_at_rest=self._median_at_rest), (self.bundles, self.offsets)

    def _backend(self, bundle: Bundle) -> Backend:
        return OnnxBackend(bundle, PairsAtRest() if self._median_at_rest else None)


def _widen(ranges: CorrectedColumns) -> None:
    """Multiply the standard deviations of corrected ranges by `OTHER_CHANNEL_FACTOR`."""
    is_corrected = np.isin(ranges.status, CORRECTED)
    ranges.variance_m2[is_corrected] *= np.float32(OTHER_CHANNEL_FACTOR**2)
    ranges.status[is_corrected & (ranges.variance_m2 > UNRELIABLE_VARIANCE_M2)] = _UNRELIABLE


def _subtract_offset(range_m: NDArray[np.floating], offset_m: NDArray[np.float32]) -> NDArray[np.floating]:
    """Return ranges minus offsets in float32, as on boards; without an offset the unchanged range."""
    if not np.count_nonzero(offset_m):
        return range_m
    return np.where(offset_m == 0.0, range_m, range_m.astype(np.float32, copy=False) - offset_m)


def _is_valid_range(range_m: NDArray[np.floating]) -> NDArray[np.bool_]:
    return (range_m >= 0.0) & (range_m <= MAX_RANGE_M)
