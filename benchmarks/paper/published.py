"""Published results of the paper, section III. Constants only."""

from __future__ import annotations

from typing import NamedTuple


class PaperModel(NamedTuple):
    """One row of Tables 1 to 3; measured on DeepUWB's medium room and on an Arduino Nano 33 BLE Sense.

    Attributes:
        mae_m, size_kb: values of float, optimised graph and int8 (Tables 1 and 2); kB of 1000 bytes.
        board: rate, Hz; supply, V; current, mA; power, mW; energy, mJ of one inference (Table 3).
    """

    parameters: int
    mae_m: tuple[float, float, float]
    size_kb: tuple[float, float, float]
    board: tuple[float, float, float, float, float]


MODELS = {
    ("remnet", 157): PaperModel(
        5905, (0.0687, 0.0687, 0.0690), (317.321, 32.988, 23.088), (17.2, 3.3, 16.2, 53.4, 3.1)
    ),
    ("remnet", 128): PaperModel(
        5841, (0.0702, 0.0702, 0.0698), (317.321, 32.732, 23.024), (21.2, 3.3, 16.0, 52.8, 2.5)
    ),
    ("remnet", 64): PaperModel(
        5713, (0.0704, 0.0704, 0.0701), (317.157, 32.220, 22.896), (41.0, 3.3, 15.8, 52.2, 1.3)
    ),
    ("remnet", 32): PaperModel(
        5649, (0.0710, 0.0710, 0.0713), (317.052, 31.964, 22.832), (77.8, 3.3, 15.6, 51.6, 0.66)
    ),
    ("remnet", 16): PaperModel(
        5617, (0.0712, 0.0712, 0.0714), (317.499, 31.836, 22.800), (140.0, 3.3, 15.6, 51.6, 0.37)
    ),
    ("mlp", 157): PaperModel(
        54401, (0.0769, 0.0777, 0.0775), (216.047, 125.885, 60.320), (184.1, 3.3, 16.2, 53.4, 0.29)
    ),
}
"""Published results by network and window length K."""

WINDOWS = (157, 128, 64, 32, 16, 8)
"""Lengths K of the CIR that the paper compares."""

SEEDS, EPOCHS, LEARNING_RATE, BATCH = 5, 30, 3e-4, 32
RAW_MAE_M, RAW_SIGMA_M = 0.1242, 0.1642
"""Errors of the test room before correction (section III-C)."""
