"""The batch smoother: linear algebra, comparison with SciPy, and consistency."""

from dataclasses import replace

import numpy as np
import pytest
from drives import HALL, anchors_at, block, drive
from scipy.optimize import least_squares

from uwb_mitigation.positioning.batch.least_squares import LeastSquares
from uwb_mitigation.positioning.batch.smoother import Smoother, knots_of, smooth
from uwb_mitigation.positioning.config import EstimatorConfig
from uwb_mitigation.positioning.noise_model import NoiseModel
from uwb_mitigation.positioning.online.tag_estimator import TagEstimator
from uwb_mitigation.positioning.track_errors import track_errors
from uwb_mitigation.types.tracks import Track, TruePath


def test_least_squares_solves_as_a_dense_matrix_does():
    rng = np.random.default_rng(1)
    knots, b, q = 6, 3, 2
    problem = LeastSquares(knots, b, q)
    dense, target = np.zeros((200, knots * b + q)), rng.normal(0, 1, 200)
    columns, values = np.zeros((200, 2 * b + q), int), rng.normal(0, 1, (200, 2 * b + q))
    for n in range(200):  # each row has unknowns of two neighbouring knots and the shared ones
        first = (n % (knots - 1)) * b
        columns[n] = [*range(first, first + 2 * b), *range(knots * b, knots * b + q)]
        dense[n, columns[n]] = values[n]
    problem.add(columns, values, target, 4.0)
    solution = problem.solve()
    inverse = np.linalg.inv(4.0 * dense.T @ dense)
    wanted = inverse @ (4.0 * dense.T @ target)
    np.testing.assert_allclose(solution.x.reshape(-1), wanted[:-q], atol=1e-9)
    np.testing.assert_allclose(solution.shared, wanted[-q:], atol=1e-9)
    np.testing.assert_allclose(solution.shared_covariance, inverse[-q:, -q:], atol=1e-9)
    for k, found in enumerate(solution.covariances(2)):
        np.testing.assert_allclose(found, inverse[k * b : k * b + 2, k * b : k * b + 2], atol=1e-9)
    adapted = dense[:, -q:] - dense[:, :-q] @ np.linalg.lstsq(dense[:, :-q], dense[:, -q:])[0]
    np.testing.assert_allclose(solution.reduced(columns, values), adapted, atol=1e-9)


def test_smoother_agrees_with_nonlinear_least_squares():
    """SciPy with numerical derivatives as an oracle: independent errors, no robust loss, no offsets."""
    model = NoiseModel(long=100.0, short=100.0, smoother_white=1.0, offset_sd=1e-6, pair_sd=1e-6)
    ranges, truth = drive(seconds=4, model=NoiseModel(white=1.0), offset_m=0.0)
    knots_ns, of = knots_of(ranges.stamp_ns)
    ranges = ranges.take(np.flatnonzero(ranges.stamp_ns == knots_ns[of]))
    smoothed = Smoother(EstimatorConfig(HALL, model), ranges).fit(known_track(truth), 30)
    knots_ns, of = knots_of(ranges.stamp_ns)
    sd = np.sqrt(model.range_sd**2 + HALL.sd[ranges.anchor] ** 2)
    dt = np.diff(knots_ns)[:, None] / 1e9
    q = model.acceleration**2 * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
    root = np.linalg.cholesky(np.linalg.inv(q[..., 0].transpose(2, 0, 1))).transpose(0, 2, 1)

    def residuals(x):
        position, velocity = x.reshape(2, -1, 3)
        distance = np.linalg.norm(position[of] - HALL.position[ranges.anchor], axis=1)
        step = np.stack([np.diff(position, axis=0) - dt * velocity[:-1], np.diff(velocity, axis=0)], axis=1)
        parts = (distance - ranges.range_m) / sd, root @ step, velocity[0] / model.speed
        return np.concatenate([part.reshape(-1) for part in parts])

    start = np.stack([truth.position_at(knots_ns), np.zeros((len(knots_ns), 3))])
    found = least_squares(residuals, start.reshape(-1), method="lm")
    np.testing.assert_allclose(smoothed.track.position, found.x.reshape(2, -1, 3)[0], atol=2e-3)
    covariance = np.linalg.inv(found.jac.T @ found.jac)
    for k in (0, len(knots_ns) // 2, len(knots_ns) - 1):
        own = slice(3 * k, 3 * k + 3)
        np.testing.assert_allclose(
            smoothed.track.covariance[k, :3, :3], covariance[own, own], rtol=0.02, atol=1e-4
        )


def known_track(truth: TruePath) -> Track:
    return Track(truth.stamp_ns, truth.position, np.zeros((len(truth), 3)), np.zeros((len(truth), 6, 6)))


def test_smoothed_tracks_are_consistent_and_better_than_live_ones():
    live, smooth = [], []
    # The errors of the drives are those of the model.
    config = EstimatorConfig(HALL, NoiseModel(smoother_white=NoiseModel().white))
    for seed in range(6):
        rng = np.random.default_rng(seed)
        ranges, truth = drive(seconds=25, seed=seed, offset_m=rng.normal(0, NoiseModel().offset_sd))
        ranges.range_m[:] += rng.normal(0, NoiseModel().pair_sd, len(HALL))[ranges.anchor]
        first = TagEstimator(EstimatorConfig(HALL)).run(ranges)
        live.append(track_errors(first, truth).rmse)
        smooth.append(track_errors(Smoother(config, ranges).fit(first).track, truth))
    assert np.mean([e.rmse for e in smooth]) < 0.95 * np.mean(live)
    assert 0.5 < np.mean([e.nees_per_dof for e in smooth]) < 1.6


@pytest.mark.parametrize("seed", range(2))
def test_smoothed_track_among_obstacles_is_not_worse_than_live(seed: int):
    box = np.array([(x, y, z) for x in (0.0, 12.0) for y in (0.0, 9.0) for z in (0.2, 2.8)])
    anchors = anchors_at(box, 0.03)
    ranges, truth = drive(anchors, seconds=40, seed=seed)
    block(ranges, seed)
    # Obstacles make raw ranges too long, which have no variance.
    ranges = replace(ranges, variance_m2=np.full(len(ranges), np.nan), is_corrected=False)
    live = TagEstimator(EstimatorConfig(anchors)).run(ranges)
    of_live = track_errors(live, truth)
    errors = track_errors(smooth(EstimatorConfig(anchors), ranges, live), truth)
    assert errors.epochs > 380
    assert errors.rmse < 1.1 * of_live.rmse
    assert errors.height_rmse < 1.2 * of_live.height_rmse
    assert errors.coverage95 > 0.85
