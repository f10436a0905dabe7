"""The batch smoother: its linear algebra, gtsam as an oracle, and honesty."""

from __future__ import annotations

import numpy as np
import pytest
from drives import HALL, block, drive

from uwb_mitigation.positioning.anchors import Anchor, AnchorMap
from uwb_mitigation.positioning.least_squares import LeastSquares
from uwb_mitigation.positioning.locator import Setting, TagLocator, run_live
from uwb_mitigation.positioning.model import Model, Regressors
from uwb_mitigation.positioning.smoother import Smoother, knots_of, smooth
from uwb_mitigation.positioning.tracks import Ranges, Track, track_errors


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
    rows = problem.add(columns, values, target, 4.0)
    solution = problem.solve()
    inverse = np.linalg.inv(4.0 * dense.T @ dense)
    wanted = inverse @ (4.0 * dense.T @ target)
    np.testing.assert_allclose(solution.x.reshape(-1), wanted[:-q], atol=1e-9)
    np.testing.assert_allclose(solution.shared, wanted[-q:], atol=1e-9)
    np.testing.assert_allclose(solution.shared_covariance, inverse[-q:, -q:], atol=1e-9)
    for k, found in enumerate(solution.covariances(2)):
        np.testing.assert_allclose(found, inverse[k * b : k * b + 2, k * b : k * b + 2], atol=1e-9)
    adapted = dense[:, -q:] - dense[:, :-q] @ np.linalg.lstsq(dense[:, :-q], dense[:, -q:])[0]
    np.testing.assert_allclose(solution.reduced(rows), adapted, atol=1e-9)


def test_the_smoother_agrees_with_gtsam():
    gtsam = pytest.importorskip("gtsam")
    # Persisting errors so small, and robustness so far, that ranges err independently, as gtsam's factors do.
    model = Model(long=100.0, short=100.0, white=1.0, offset_sd=1e-6, pair_sd=1e-6)
    ranges, truth = drive(seconds=6, model=Model(white=1.0), offset_m=0.0)
    knots_ns, of = knots_of(ranges.stamp_ns)
    # gtsam has ranges at the knots: as many of the drive's.
    at = np.flatnonzero(ranges.stamp_ns == knots_ns[of])
    ranges = ranges.take(at)
    mine = Smoother(HALL, model, ranges).fit(Track(truth.stamp_ns, truth.position, *_nothing(len(truth))), 30)
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    knots_ns, of = knots_of(ranges.stamp_ns)
    variance = model.range_sd**2 + HALL.sd**2
    key = [gtsam.symbol("x", k) for k in range(len(knots_ns))]
    for row, place in enumerate(HALL.position):
        anchor = gtsam.symbol("a", row)
        values.insert(anchor, gtsam.Point3(*place))
        graph.add(gtsam.NonlinearEqualityPoint3(anchor, gtsam.Point3(*place)))
    speeds = [gtsam.symbol("v", k) for k in range(len(knots_ns))]
    dt = np.diff(knots_ns / 1e9)
    for k in range(len(knots_ns)):
        values.insert(key[k], gtsam.Point3(*truth.position[at[k]]))
        values.insert(speeds[k], np.zeros(3))
    graph.add(
        gtsam.PriorFactorVector(speeds[0], np.zeros(3), gtsam.noiseModel.Isotropic.Sigma(3, model.speed))
    )
    for k, step in enumerate(dt):
        q = model.acceleration**2 * np.array([[step**3 / 3, step**2 / 2], [step**2 / 2, step]])
        root = np.linalg.cholesky(np.linalg.inv(q)).T
        _motion(gtsam, graph, key, speeds, k, step, root)
    for i in range(len(ranges)):
        noise = gtsam.noiseModel.Isotropic.Sigma(1, float(np.sqrt(variance[ranges.anchor[i]])))
        factor = gtsam.RangeFactor3(
            key[of[i]], gtsam.symbol("a", int(ranges.anchor[i])), ranges.range_m[i], noise
        )
        graph.add(factor)
    solved = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    theirs = np.array([solved.atPoint3(one) for one in key])
    np.testing.assert_allclose(mine.track.position, theirs, atol=2e-3)
    marginals = gtsam.Marginals(graph, solved)
    for k in (0, len(key) // 2, len(key) - 1):
        np.testing.assert_allclose(
            mine.track.covariance[k, :3, :3], marginals.marginalCovariance(key[k]), rtol=0.02, atol=1e-4
        )


def _nothing(n: int):
    return np.zeros((n, 3)), np.zeros((n, 6, 6))


def _motion(gtsam, graph, key, speeds, k: int, step: float, root) -> None:
    def error(factor, values, jacobians):
        p0, p1 = values.atPoint3(key[k]), values.atPoint3(key[k + 1])
        v0, v1 = values.atVector(speeds[k]), values.atVector(speeds[k + 1])
        eye = np.eye(3)
        if jacobians is not None:
            jacobians[0] = np.asfortranarray(np.kron(root, eye) @ np.vstack([-eye, 0 * eye]))
            jacobians[1] = np.asfortranarray(np.kron(root, eye) @ np.vstack([eye, 0 * eye]))
            jacobians[2] = np.asfortranarray(np.kron(root, eye) @ np.vstack([-step * eye, -eye]))
            jacobians[3] = np.asfortranarray(np.kron(root, eye) @ np.vstack([0 * eye, eye]))
        return np.kron(root, eye) @ np.concatenate([p1 - p0 - step * v0, v1 - v0])

    keys = [key[k], key[k + 1], speeds[k], speeds[k + 1]]
    graph.add(gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(6), keys, error))


def test_smoothed_tracks_of_many_drives_are_honest_and_better_than_live_ones():
    live, smooth = [], []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        ranges, truth = drive(seconds=25, seed=seed, offset_m=rng.normal(0, Model().offset_sd))
        ranges = Ranges(
            ranges.stamp_ns,
            ranges.anchor,
            ranges.range_m + rng.normal(0, Model().pair_sd, len(HALL))[ranges.anchor],
            ranges.variance_m2,
            ranges.rx_power_dbm,
        )
        first = run_live(ranges, TagLocator(HALL)).track
        live.append(track_errors(first, truth).rmse)
        smooth.append(track_errors(Smoother(HALL, Model(), ranges).fit(first).track, truth))
    assert np.mean([e.rmse for e in smooth]) < 0.95 * np.mean(live)
    assert 0.5 < np.mean([e.nees_per_dof for e in smooth]) < 1.6


def test_parameters_that_ranges_share_are_found_with_the_track():
    ranges, truth = drive(seconds=60, offset_m=0.0)
    power = np.random.default_rng(4).normal(0, 1, len(ranges))
    ranges.range_m[:] += 0.3 * power + 0.5 * (ranges.anchor == 3)
    rows = np.stack([power, ranges.anchor == 3], axis=1).astype(float)
    wanted = Regressors(("line", "anchor"), rows, np.zeros(2), np.ones(2), np.zeros(len(rows), int))
    found = Smoother(HALL, Model(), ranges, parameters=wanted).fit(
        Track(truth.stamp_ns, truth.position, *_nothing(len(truth)))
    )
    sd = np.sqrt(np.diag(found.parameter_covariance))
    assert np.abs(found.parameters - (0.3, 0.5)).max() < 3 * sd.max()
    assert np.abs(found.parameters[0] - 0.3) < 0.01


@pytest.mark.parametrize("seed", range(4))
def test_a_track_smoothed_among_obstacles_is_not_worse_than_live(seed: int):
    box = np.array([(x, y, z) for x in (0.0, 12.0) for y in (0.0, 9.0) for z in (0.2, 2.8)])
    anchors = AnchorMap([Anchor(i, tuple(p), 0.03) for i, p in enumerate(box.tolist(), 1)])
    ranges, truth = drive(anchors, seconds=40, seed=seed)
    block(ranges, seed)
    live = run_live(ranges, TagLocator(anchors)).track
    of_live = track_errors(live, truth)
    errors = track_errors(smooth(Setting(anchors), ranges, live), truth)
    assert errors.epochs > 380
    assert errors.rmse < 1.1 * of_live.rmse
    assert errors.height_rmse < 1.2 * of_live.height_rmse
    assert errors.coverage95 > 0.85
