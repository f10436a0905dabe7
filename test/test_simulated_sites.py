"""Random sites: seeded, small enough to be heard in, and driven through their doorways."""

from __future__ import annotations

import numpy as np
import pytest

from uwb_mitigation.sources.simulation.scene import along_route
from uwb_mitigation.sources.simulation.sites import SIDE_M, draw_site


def drawn(seed: int):
    rng = np.random.default_rng(seed)
    site = draw_site(4 + seed % 5, rng)
    return site, site.route(rng)


@pytest.mark.parametrize("seed", range(4))
def test_a_tag_goes_through_doorways_and_not_through_walls(seed):
    site, route = drawn(seed)
    assert len(site.anchors) == 4 + seed % 5
    assert all(SIDE_M[0] <= side <= SIDE_M[1] for side in site.plan.size)
    places = along_route(route, np.arange(0.0, 40.0, 0.05))
    assert site.plan.direct_path(places[:-1], places[1:]).crossings.sum() == 0
    assert np.hypot(*np.diff(places, axis=0).T).max() < 0.06
