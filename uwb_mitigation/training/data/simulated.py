"""Generate simulated placements directly as arrays, without writing a recording."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Iterable
from contextlib import ExitStack
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.mitigation.early_path import early_path_error_m
from uwb_mitigation.mitigation.preprocessing import Preprocessing
from uwb_mitigation.simulation.antenna_pairs import label
from uwb_mitigation.simulation.buildings import RADIO, WIDE_SHARE, block_of
from uwb_mitigation.simulation.radio import Receiver, Reception
from uwb_mitigation.training.data.dataset import Dataset
from uwb_mitigation.types.measurement import Encoding, RangeColumns, Segment


def building_dataset(
    seed: int,
    blocks: int,
    preprocessing: Preprocessing,
    workers: int,
    on_block: Callable[[], None] = lambda: None,
    *,
    radio: Receiver = RADIO,
    wide_share: float = WIDE_SHARE,
) -> Dataset:
    """Return one range of each of the first `blocks` x 256 placements of `sources.simulated`, in its order.

    Ranges that are not received, or whose window is not usable, are omitted. The result does not depend on the number
    of `workers` (processes; 1: this one); `on_block` is called after each block. `radio`, `wide_share`: see `block_of`.
    """
    simulate = partial(block_dataset, seed, preprocessing, radio, wide_share)
    blocks_of_ranges = []
    with ExitStack() as stack:
        run: Callable[..., Iterable[Dataset]] = map
        if workers > 1:
            # Do not fork: the caller may run threads (torch, a progress bar).
            run = stack.enter_context(multiprocessing.get_context("spawn").Pool(workers)).imap
        for block in run(simulate, range(blocks)):
            blocks_of_ranges.append(block)
            on_block()
    return replace(Dataset.joined(blocks_of_ranges), radios=(radio.kind,), segments=(radio.segment,))


def block_dataset(
    seed: int, preprocessing: Preprocessing, radio: Receiver, wide_share: float, number: int
) -> Dataset:
    """Return one range of each placement of block `number`; see `building_dataset`."""
    block, rng = block_of(seed, number, radio=radio, wide_share=wide_share)
    reception = radio.receive(block.pairs.multipath(rng), rng, block.boards)
    distance = block.pairs.distance_m
    received = np.flatnonzero(np.isfinite(reception.first_path_index))
    columns = _columns(reception, distance, received)
    faults, inputs = preprocessing.apply(columns)
    early_m = None
    if radio.segment is Segment.IPATOV:  # Other radios deliver too few taps before the first path.
        early_m = early_path_error_m(columns, np.flatnonzero(faults == 0), preprocessing.samples)
    rows = received[faults == 0]
    is_blocked, is_direct = block.pairs.path.crossings > 0, reception.direct_above_threshold
    return Dataset(
        preprocessing,
        inputs,
        reception.rx_power_dbm[rows].astype(np.float32),
        reception.first_path_power_dbm[rows].astype(np.float32),
        distance[rows] + reception.error_m[rows],
        reception.error_m[rows],
        np.array([block.configuration(seed, number, int(row)) for row in rows]),
        np.array([label(bool(is_blocked[row]), bool(is_direct[row])) for row in rows]),
        early_path_m=early_m,
    )


def _columns(reception: Reception, distance: NDArray[np.float64], rows: NDArray[np.intp]) -> RangeColumns:
    n = len(rows)
    unknown = np.zeros(n, np.uint64)
    return RangeColumns(
        unknown,
        unknown,
        (distance + reception.error_m)[rows].astype(np.float32),
        Encoding.COMPLEX_INT16,
        reception.samples[rows],
        np.zeros(n, np.int32),
        reception.first_path_index[rows].astype(np.float32),
        np.ones(n, np.float32),
        reception.preamble_count[rows].astype(np.uint16),
        reception.rx_power_dbm[rows].astype(np.float32),
        reception.first_path_power_dbm[rows].astype(np.float32),
    )
