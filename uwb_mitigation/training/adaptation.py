"""A site of one's own: from a model that was trained elsewhere to one that fits other boards and other walls."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from uwb_mitigation.evaluation import lad, splits
from uwb_mitigation.evaluation.dataset import Dataset
from uwb_mitigation.model import floating
from uwb_mitigation.model.architecture import Remnet
from uwb_mitigation.model.bundle import Bundle
from uwb_mitigation.model.float_networks import float_network, scaled
from uwb_mitigation.training import choosing
from uwb_mitigation.training.choosing import NESTED, Candidate, Choice, Fitted
from uwb_mitigation.training.fitting import FitOptions, fit
from uwb_mitigation.training.recipe import CrossValidation, GradedModel, Recipe, describe, prior_m

__all__ = ["NESTED", "candidates", "fit_chosen"]

PER_CONFIGURATION = 20
AS_SHIPPED = "as shipped"
OWN_OFFSET = "own offset"
TRAINED_FURTHER = "trained further"


def candidates(source: Bundle, options: FitOptions) -> list[Candidate]:
    """The source's model as it is, with another offset, a constant, a line, and the source's network trained further on
    what a prior of the site's own leaves: a line if the source has one, else an offset.

    Raises:
        ModelError: the source's network is no REMNet.
    """
    network = float_network(source)

    def shifted(data: Dataset, seed: int) -> Fitted:
        left = data.error_m - prior_m(source.prior, data) - floating.predict_m(network, data.inputs)
        known = np.isfinite(left)
        shift = lad.constant(data.configurations[known], left[known]).offset_m if known.any() else 0.0
        return replace(source.prior, offset_m=float(np.float32(source.prior.offset_m + shift))), network

    def trained(data: Dataset, seed: int) -> Fitted:
        if source.prior.needs_power:
            prior = choosing.line(data)
        else:
            left = data.error_m - floating.predict_m(network, data.inputs)
            prior = lad.constant(data.configurations, left)
        part = data.rows(splits.thinned(data.configurations, PER_CONFIGURATION, seed))
        left = part.error_m - prior_m(prior, part)
        known = np.isfinite(left)
        chosen = replace(options, seed=seed)
        return prior, fit(source.architecture, part.inputs[known], left[known], chosen, start=network)

    return [
        Candidate(AS_SHIPPED, lambda data, seed: (source.prior, network)),
        Candidate(OWN_OFFSET, shifted),
        Candidate(
            choosing.CONSTANT, lambda data, seed: (lad.constant(data.configurations, data.error_m), None)
        ),
        Candidate(choosing.LINE, lambda data, seed: (choosing.line(data), None)),
        Candidate(TRAINED_FURTHER, trained, trains=True),
    ]


def fit_chosen(
    dataset: Dataset,
    choice: Choice,
    every: Sequence[Candidate],
    source: Bundle,
    options: FitOptions,
    name: str,
    data: str,
) -> tuple[GradedModel, CrossValidation]:
    """The chosen model of all of the dataset, and the errors on held-out configurations that its intervals are from.

    Raises:
        ModelError: the source's network is no REMNet.
    """
    silent = scaled(float_network(source), 0.0)
    assert isinstance(silent.architecture, Remnet)
    (candidate,) = (item for item in every if item.name == choice.chosen)
    prior, network = candidate.fit(dataset, choice.seed)
    recipe = Recipe(
        silent.architecture,
        options,
        line=prior.needs_power,
        per_configuration=PER_CONFIGURATION,
        network=choice.chosen == TRAINED_FURTHER,
    )
    validation = CrossValidation(
        dataset, {**choice.errors, "float": choice.errors[choice.chosen]}, choice.folds, choice.seed
    )
    card = describe(name, recipe, prior, validation, data)
    # A network that is kept as `source` has it is there, but how it was fitted is told by the card of `source`.
    made = {**card.training["recipe"], "network": network is not None}
    started = {"started_from": f"{source.model_id:08x}", "chosen": choice.chosen, "recipe": made}
    card = replace(card, training={**card.training, **started})
    return GradedModel(card, silent if network is None else network), validation
