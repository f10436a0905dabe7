"""The model of a site from ranges whose truth a track or a localisation tells: chosen, and graded.

Candidates stand in order, simple before rich; a richer one must better the simpler by `MUST_GAIN` on stretches of the
track, and on anchors, that it was not fitted to. Only the last one needs torch, which is imported for it alone.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.errors import DatasetError
from uwb_mitigation.evaluation import lad, splits
from uwb_mitigation.evaluation.dataset import Dataset
from uwb_mitigation.evaluation.preference import MUST_GAIN, preferred
from uwb_mitigation.model import graph
from uwb_mitigation.model.architecture import Architecture
from uwb_mitigation.model.bundle import Bundle, Card, made_bundle, session_options
from uwb_mitigation.model.float_networks import float_network, scaled
from uwb_mitigation.model.prior import LinePrior
from uwb_mitigation.model.weights import FloatWeights
from uwb_mitigation.training.cards import card_of, familiarity_of
from uwb_mitigation.training.options import FitOptions

OFFSETS, LINE, UNIVERSAL, UNIVERSAL_LINE, TUNED = CANDIDATES = (
    "offsets",
    "offsets + line",
    "offsets + universal network",
    "offsets + universal network + line",
    "fine-tuned network",
)

PER_CONFIGURATION = 6
MOST_INPUTS = 2500
"""The fine-tuned network is fitted to so many at most, of each configuration to so few."""

FACTORS, LEAST_SPREAD_M = (0.0, 1.5), 0.05
"""Of the universal network's predictions: noise in what predicts pulls the best factor below 1, which only offsets that
are sought with it would suffer from."""

OffsetsWithout = Callable[[NDArray[np.intp]], NDArray[np.float64]]
"""Of rows that are held out, float64 (n,): by how much the offset of each range grows when it is found without them, m."""

_BATCH = 1024
TUNING = FitOptions(epochs=2, learning_rate=3e-4, dropout=0.2)
STRETCH_FOLDS, ANCHOR_FOLDS = 4, 2


@dataclass(frozen=True, slots=True, eq=False)
class Fitted:
    """A prior and, or not, a network; `factor`: it is the universal one, so many times as strong."""

    prior: LinePrior
    network: FloatWeights | None = None
    factor: float | None = None

    def predicted_m(self, data: Dataset) -> NDArray[np.float64]:
        """Prior + network, float64 (n,), m; 0 where a power that it needs is not known: such a range is passed through."""
        prior = self.prior
        first_path = data.first_path_power_dbm if prior.per_power_gap != 0.0 else data.rx_power_dbm
        predicted = prior.predict_m(data.rx_power_dbm, first_path).astype(np.float64)
        if self.factor is not None:
            predicted = predicted + self.factor * _universal_m(data)
        elif self.network is not None:
            predicted = predicted + network_m(self.network, data.inputs)
        return np.where(np.isfinite(predicted), predicted, 0.0)


def network_m(network: FloatWeights, inputs: NDArray[np.float32]) -> NDArray[np.float64]:
    """What a network predicts, float64 (n,), m, by ONNX Runtime: many times as fast as `floating`."""
    import onnxruntime

    session = onnxruntime.InferenceSession(
        graph.float_model(network), session_options(), providers=["CPUExecutionProvider"]
    )
    (source,), (result,) = session.get_inputs(), session.get_outputs()
    parts = [
        session.run([result.name], {source.name: inputs[start : start + _BATCH, None, :]})[0][:, 0]
        for start in range(0, len(inputs), _BATCH)
    ]
    return np.concatenate(parts).astype(np.float64)


def _universal_m(data: Dataset) -> NDArray[np.float64]:
    assert data.headers is not None
    return data.headers[:, 0].astype(np.float64)


@dataclass(frozen=True, slots=True, eq=False)
class SiteChoice:
    """Attributes:
    chosen: one of `CANDIDATES`.
    errors: {`raw`, candidate: float64 (n + n,) or (n,)}, m, on stretches held out, then on anchors held out.
    held_out: {the same: float64 (n,)}, on stretches held out alone: one error of each range.
    prior, network: of all of the data. factor: by which the network multiplies the universal one's predictions; 0 = no
        network, 1 = a fine-tuned one.
    notes: what was not tried, and why.
    """

    chosen: str
    errors: Mapping[str, NDArray[np.float64]]
    held_out: Mapping[str, NDArray[np.float64]]
    prior: LinePrior
    network: FloatWeights | None
    factor: float
    notes: tuple[str, ...]

    def mae(self) -> dict[str, float]:
        """{name: MAE on what was held out}, m."""
        return {name: float(np.abs(error).mean()) for name, error in self.errors.items()}


def choose(
    data: Dataset,
    has_cirs: bool,
    source: Bundle,
    seed: int = 0,
    on_share: Callable[[float], None] = lambda share: None,
    *,
    offsets_without: OffsetsWithout,
) -> SiteChoice:
    """Choose among the candidates, and fit the chosen one to all of the data.

    Of a stretch that is held out the radios' offsets, too, are found without it. Not of an anchor: its own offset is told
    by its own ranges alone.

    Args:
        data: as `SiteData.labelled` makes it, less the offsets.
        source: the universal model.

    Raises:
        DatasetError: too little to hold anything out.
    """
    if has_cirs:
        # The universal network's answer stands in the headers: it is asked once, not in every fold.
        predicted = network_m(float_network(source), data.inputs)
        data = replace(data, headers=predicted[:, None].astype(np.float32))
    every, notes = _candidates(has_cirs, source, seed)
    stretches = np.array([name.split("/")[0] for name in data.configurations])
    assert data.anchors is not None
    parts = [(0, split) for split in _folds(stretches, STRETCH_FOLDS, seed)]
    parts += [(1, split) for split in _folds(data.anchors.astype(str), ANCHOR_FOLDS, seed)]
    if not parts or parts[0][0] == 1:
        raise DatasetError(
            "one stretch of ranges: nothing can be held out", valid="a longer drive, or more places"
        )
    errors = {name: np.tile(data.error_m, 2) for name in every}
    for number, (kind, split) in enumerate(parts):
        fold = _less(data, offsets_without(split.test)) if kind == 0 else data
        train, test = fold.rows(split.train), fold.rows(split.test)
        for name, fit in every.items():
            errors[name][split.test + kind * len(data)] = test.error_m - fit(train).predicted_m(test)
        on_share((number + 1) / (len(parts) + 1))
    if parts[-1][0] == 0:
        errors = {name: error[: len(data)] for name, error in errors.items()}
    chosen = preferred(errors, MUST_GAIN)
    fitted = every[chosen](data)
    on_share(1.0)
    return SiteChoice(
        chosen,
        errors,
        {name: error[: len(data)] for name, error in errors.items()},
        fitted.prior,
        fitted.network,
        0.0 if fitted.network is None else 1.0 if fitted.factor is None else fitted.factor,
        tuple(notes),
    )


def _less(data: Dataset, offset_m: NDArray[np.float64]) -> Dataset:
    return replace(data, range_m=data.range_m - offset_m, error_m=data.error_m - offset_m)


def bundle_of(
    path: Path,
    data: Dataset,
    choice: SiteChoice,
    source: Bundle,
    raw_m: NDArray[np.float64],
    training: Mapping[str, Any],
) -> tuple[Bundle, bytes]:
    """The chosen model as a float bundle to be written to `path`, and its bytes; its intervals are from the errors on
    stretches held out.

    Args:
        raw_m: float64 (n,), errors of the ranges as measured.
        training: what the card says of where it comes from.
    """
    silent = choice.network is None
    network = scaled(float_network(source), 0.0) if choice.network is None else choice.network
    architecture: Architecture = source.architecture
    familiarity = None if silent else familiarity_of(data)
    left = choice.held_out[choice.chosen]
    card: Card = card_of(path.stem, architecture, data, choice.prior, data, left, training, familiarity)
    if not silent:
        # What another part of the site does, a drive has not seen: the universal model's bounds are wider.
        low, high = source.card.correction_limits_m
        card = replace(
            card,
            correction_limits_m=(
                min(low, card.correction_limits_m[0]),
                max(high, card.correction_limits_m[1]),
            ),
            familiarity=familiarity,
        )
    return made_bundle(path, graph.float_model(network), replace(card, needs_cir=not silent))


def _candidates(
    has_cirs: bool, source: Bundle, seed: int
) -> tuple[dict[str, Callable[[Dataset], Fitted]], list[str]]:
    def offsets(data: Dataset) -> Fitted:
        return Fitted(lad.constant(data.configurations, data.error_m))

    def line(data: Dataset) -> Fitted:
        return Fitted(_line(data, data.error_m))

    if not has_cirs:
        return {OFFSETS: offsets, LINE: line}, ["networks: the recording has no CIRs"]
    start = float_network(source)

    def universal(data: Dataset) -> Fitted:
        factor = _factor(data)
        shift = lad.constant(data.configurations, data.error_m - factor * _universal_m(data))
        return Fitted(shift, scaled(start, factor), factor)

    def universal_line(data: Dataset) -> Fitted:
        factor = _factor(data)
        left = data.error_m - factor * _universal_m(data)
        # The bundle of a network passes ranges through whose first-path power is not known.
        line = _line(data, left) if _has_both_powers(data) else lad.constant(data.configurations, left)
        return Fitted(line, scaled(start, factor), factor)

    every: dict[str, Callable[[Dataset], Fitted]] = {
        OFFSETS: offsets,
        UNIVERSAL: universal,
        UNIVERSAL_LINE: universal_line,
    }
    if importlib.util.find_spec("torch") is None:
        return every, ["the fine-tuned network: torch is not installed (`make setup-training`)"]
    from uwb_mitigation.training.fitting import fit

    def tuned(data: Dataset) -> Fitted:
        shift = lad.constant(data.configurations, data.error_m - _universal_m(data))
        part = data.rows(splits.thinned(data.configurations, PER_CONFIGURATION, seed))
        if len(part) > MOST_INPUTS:
            part = part.rows(
                np.sort(np.random.default_rng(seed).choice(len(part), MOST_INPUTS, replace=False))
            )
        wanted = part.error_m - shift.offset_m
        return Fitted(
            shift, fit(source.architecture, part.inputs, wanted, replace(TUNING, seed=seed), start=start)
        )

    return {**every, TUNED: tuned}, []


def _factor(data: Dataset) -> float:
    """By how much the universal network's predictions are to be multiplied to predict the errors best."""
    predicted = _universal_m(data)
    means = [lad.means(data.configurations, values) for values in (predicted, data.error_m)]
    if len(means[0]) < lad.MIN_CONFIGURATIONS or float(np.ptp(means[0])) < LEAST_SPREAD_M:
        return 1.0
    design = np.column_stack([np.ones(len(means[0])), means[0]])
    factor = float(lad.least_absolute_deviations(design, means[1])[1])
    return float(np.float32(np.clip(factor, *FACTORS)))


def _has_both_powers(data: Dataset) -> bool:
    return bool(np.isfinite(data.rx_power_dbm - data.first_path_power_dbm).mean() > 0.5)


def _line(data: Dataset, error_m: NDArray[np.float64]) -> LinePrior:
    """A line in both powers where both are known, in the received one where only that is, else a constant."""
    if _has_both_powers(data):
        return lad.fit_prior(data.configurations, data.rx_power_dbm, data.first_path_power_dbm, error_m)
    return lad.fit_level(data.configurations, data.rx_power_dbm, error_m)


def _folds(groups: NDArray[np.str_], folds: int, seed: int) -> Sequence[splits.Split]:
    """Folds over groups (n,), as many as there can be; none of a single group."""
    count = min(folds, len(np.unique(groups)))
    return splits.by_configuration(groups, count, seed) if count >= 2 else []
