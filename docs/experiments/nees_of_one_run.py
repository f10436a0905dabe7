"""Simulate how much the NEES of a single drive varies if the error model is exact.

Each Hanyang drive is repeated with its own times, anchors and true path, and with ranges whose errors follow the noise model exactly,
20 times. Errors that persist leave few independent samples per drive: the 5th to 95th percentiles of the live NEES per degree of
freedom are 0.7 to 3.3 in five drives and up to 82 in NLOS_B4, so no model can guarantee 0.5 to 2 in each drive.

Arguments: the folder of the drives, and the number of repetitions.
"""

import sys
from pathlib import Path

import numpy as np

from benchmarks.positions import HEIGHT, at_truths, hanyang_run
from uwb_mitigation.positioning.batch.smoother import Smoother
from uwb_mitigation.positioning.noise_model import NoiseModel
from uwb_mitigation.positioning.online.tag_estimator import EstimatorConfig, TagEstimator
from uwb_mitigation.types.anchors import AnchorMap
from uwb_mitigation.types.tracks import Ranges, TruePath


def erring(
    ranges: Ranges, path: TruePath, anchors: AnchorMap, model: NoiseModel, rng: np.random.Generator
) -> Ranges:
    """Replace errors by those of the model: white, persistent, per-pair, common, and from anchor positions."""
    true = path.at(ranges.stamp_ns)
    known = np.isfinite(true).all(axis=1)
    ranges, true = ranges.take(known), true[known]
    place = anchors.position + rng.normal(0.0, anchors.sd[:, None], anchors.position.shape)
    error = rng.normal(0.0, np.sqrt(model.white) * model.range_sd, len(ranges)) + rng.normal(
        0.0, model.offset_sd
    )
    for row in range(len(anchors)):
        own = np.flatnonzero(ranges.anchor == row)
        kept = np.exp(-np.diff(ranges.stamp_ns[own], prepend=0) / 1e9 / model.persistence_s)
        new = rng.normal(0.0, np.sqrt(1.0 - model.white) * model.range_sd, len(own))
        persisting = 0.0
        for i, k in zip(own, range(len(own)), strict=True):
            persisting = kept[k] * persisting + np.sqrt(1.0 - kept[k] ** 2) * new[k]
            error[i] += persisting
    distance = np.linalg.norm(true - place[ranges.anchor], axis=1)
    return Ranges(
        ranges.stamp_ns,
        ranges.anchor,
        np.maximum(distance + error, 0.0),
        ranges.variance_m2,
        ranges.rx_power_dbm,
        ranges.tag_id,
    )


again = int(sys.argv[2]) if len(sys.argv) > 2 else 20
model = NoiseModel()
for folder in sorted(Path(sys.argv[1]).glob("*_*")):
    anchors, ranges, path, window = hanyang_run(folder)
    found = []
    for seed in range(again):
        drawn = erring(ranges, path, anchors, model, np.random.default_rng(seed))
        live = TagEstimator(EstimatorConfig(anchors, model, height=HEIGHT)).run(drawn)
        smoothed = Smoother(EstimatorConfig(anchors, model, height=HEIGHT), drawn).fit(live).track
        found.append([at_truths(track, window).nees_per_dof for track in (live, smoothed)])
    low, middle, high = np.percentile(found, (5, 50, 95), axis=0)
    print(
        f"{folder.name:8} NEES/dof of {again}: live {low[0]:.2f} to {high[0]:.2f}, median {middle[0]:.2f};"
        f" smoothed {low[1]:.2f} to {high[1]:.2f}, median {middle[1]:.2f}",
        flush=True,
    )
