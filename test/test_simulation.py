"""The simulator: channel and radio."""

import math
from dataclasses import replace

import numpy as np
import pytest

from uwb_mitigation.simulation import scene
from uwb_mitigation.simulation.channel import CHANNEL_2, CHANNELS, Multipath, direct_power_db
from uwb_mitigation.simulation.radio import NOISE_TAPS, POWER_CONSTANT_DB, TAP_NS, TAPS, Receiver, pulse
from uwb_mitigation.simulation.simulated import SimulatedSource

QUIET = Receiver(range_offset_m=0.0, timestamp_std_m=0.0)


def rng(seed: int = 7) -> np.random.Generator:
    return np.random.default_rng(seed)


def lone_paths(n: int, power_db: float, delay_ns: float = 0.0) -> Multipath:
    gain = 10 ** (power_db / 20) * np.exp(1j * rng().uniform(0, 2 * math.pi, (n, 1)))
    return Multipath(np.full((n, 1), delay_ns), gain)


def test_direct_path_loses_free_space_and_obstacles() -> None:
    power = direct_power_db(np.array([1.0, 10.0]), np.array([0.0, 6.0]), CHANNEL_2)
    np.testing.assert_allclose(power, [-44.5, -44.5 - 26.0], atol=0.1)


def test_wall_delays_by_its_optical_thickness_and_weakens() -> None:
    loss, excess = scene.through_slab(
        scene.Wall((0, 0), (0, 1), scene.BRICK, 0.12), np.array([1.0]), CHANNEL_2
    )
    assert excess[0] == pytest.approx((math.sqrt(scene.BRICK.permittivity) - 1) * 0.12)
    # ITU-R P.2040-1: attenuation 1636 sigma / sqrt(eps) dB/m, and two faces that reflect 10 % each.
    absorbed = 1636 * 0.038 / math.sqrt(scene.BRICK.permittivity) * 0.12
    assert loss[0] == pytest.approx(absorbed + 0.93, abs=0.02)


def test_concrete_attenuates_more_at_a_higher_frequency() -> None:
    wall = scene.Wall((0, 0), (0, 1), scene.CONCRETE, 0.2)
    (low, excess), (high, same) = (scene.through_slab(wall, np.array([1.0]), CHANNELS[n]) for n in (2, 5))
    # The faces reflect 1.47 dB; the conductivity grows with the frequency to the power of 0.8095.
    assert (high - 1.47) / (low - 1.47) == pytest.approx((6489.6 / 3993.6) ** 0.8095, rel=0.01)
    assert excess == same


def test_walls_count_only_where_the_line_crosses_them() -> None:
    plan = scene.Building(
        (4.0, 4.0),
        (scene.Wall((2, 0), (2, 2), scene.BRICK, 0.1), scene.Wall((3, 0), (3, 2), scene.BRICK, 0.1)),
    )
    a = np.array([[1.0, 1.0], [1.0, 3.0], [2.5, 1.0]])
    b = np.array([[3.5, 1.0], [3.5, 3.0], [3.5, 1.0]])
    path = plan.direct_path(a, b)
    assert path.crossings.tolist() == [2, 0, 1]
    assert path.loss_db[0] == pytest.approx(2 * path.loss_db[2])
    assert path.loss_db[1] == path.excess_m[1] == 0.0


def test_path_is_diffracted_at_the_nearer_edge_of_a_screen() -> None:
    plan = scene.Building((4.0, 4.0), screens=(scene.Screen("cabinet", (2.0, 0.0), (2.0, 1.5)),))
    path = plan.direct_path(np.array([[1.0, 1.0]]), np.array([[3.0, 1.0]]))
    detour = 2 * math.hypot(1.0, 0.5) - 2.0
    assert path.excess_m[0] == pytest.approx(detour)
    v = 2 * math.sqrt(detour / 0.0751)
    # Deep in the shadow, the loss is 13 + 20 log10 v.
    assert path.loss_db[0] == pytest.approx(13 + 20 * math.log10(v), abs=0.3)
    assert scene.knife_edge_loss_db(np.zeros(1), CHANNEL_2)[0] == pytest.approx(6.0, abs=0.1)


def test_robot_stays_inside_the_flat_moves_steadily_and_drives_through_nothing() -> None:
    travelled = np.arange(0.0, 60.0, 0.05)
    position = scene.along_route(scene.ROUTE, travelled)
    assert ((position > 0) & (position < scene.FLAT.size)).all()
    assert np.hypot(*np.diff(position, axis=0).T).max() <= 0.05 + 1e-9
    assert scene.FLAT.direct_path(position[:-1], position[1:]).crossings.max() == 0


def test_pulse_has_unit_energy_over_the_taps_and_no_sidelobes() -> None:
    taps = np.arange(-20, 21) + 0.3
    assert (pulse(taps) ** 2).sum() == pytest.approx(1.0, abs=1e-3)
    peak, half, far = pulse(np.array([0.0, 1.2, 3.0]))
    assert half == pytest.approx(peak / 2.0, rel=1e-3)
    assert far < 0.02 * peak


@pytest.mark.parametrize("number", CHANNELS)
@pytest.mark.parametrize("power_db", [-50.0, -65.0, -80.0])
def test_single_pulse_is_detected_within_a_tenth_of_a_tap(power_db: float, number: int) -> None:
    radio = replace(QUIET, channel=CHANNELS[number])
    assert np.abs(radio.receive(lone_paths(400, power_db), rng()).error_m).max() < 0.1 * TAP_NS * 0.299792458


@pytest.mark.parametrize(("direct_db", "late"), [(-75.0, False), (-112.0, True)])
def test_direct_path_below_the_threshold_makes_the_range_long(direct_db: float, late: bool) -> None:
    strong = lone_paths(200, -70.0, delay_ns=12.0)
    weak = lone_paths(200, direct_db)
    both = Multipath(np.hstack([weak.delay_ns, strong.delay_ns]), np.hstack([weak.gain, strong.gain]))
    reception = QUIET.receive(both, rng())
    assert (reception.direct_above_threshold == (not late)).all()
    np.testing.assert_allclose(reception.error_m, 12.0 * 0.299792458 if late else 0.0, atol=0.05)


def test_levels_follow_the_manuals_formulas() -> None:
    reception = QUIET.receive(lone_paths(20, -70.0), rng())
    magnitude = np.hypot(*reception.samples.astype(float).reshape(20, TAPS, 2).transpose(2, 0, 1))
    first = np.floor(reception.first_path_index).astype(int)[:, None] + (1, 2, 3)
    f2 = (np.rint(np.take_along_axis(magnitude, first, axis=1)) ** 2).sum(axis=1)
    noise = (magnitude[:, NOISE_TAPS] ** 2).mean(axis=1) * TAPS
    c = np.rint(((magnitude**2).sum(axis=1) - noise) / 2**17)
    for reported, energy in ((reception.first_path_power_dbm, f2), (reception.rx_power_dbm, c * 2**17)):
        expected = 10 * np.log10(energy / reception.preamble_count**2.0) - POWER_CONSTANT_DB
        np.testing.assert_allclose(reported, expected, atol=0.01)


def test_weak_level_is_as_sent_a_strong_one_is_compressed_and_below_the_sensitivity_there_is_none() -> None:
    weak = QUIET.receive(lone_paths(50, -80.0), rng())
    np.testing.assert_allclose(weak.rx_power_dbm, QUIET.tx_power_dbm - 80.0, atol=1.0)
    strong = QUIET.receive(lone_paths(50, -40.0), rng())
    np.testing.assert_allclose(strong.rx_power_dbm, QUIET.compression_dbm, atol=0.5)
    lost = QUIET.receive(lone_paths(5, -90.0), rng())
    assert np.isnan([lost.first_path_index, lost.rx_power_dbm]).all()


def test_gain_belongs_to_its_anchor() -> None:
    sources = [SimulatedSource(count=40, gains_db=gains) for gains in (0.0, (6.0, 0.0, 0.0, 0.0))]
    usual, stronger = ([record.measurement.cir.rx_power_dbm for record in source] for source in sources)
    higher = np.subtract(stronger, usual)
    assert 1.0 < np.median(higher[::4]) < 6.1  # strong levels are compressed
    assert (higher[1::4] == 0.0).all()
