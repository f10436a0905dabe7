"""The firmware's C, compiled for this computer, in the place of ONNX Runtime."""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.firmware_export.export import export_bundle
from uwb_mitigation.firmware_export.host import HostFirmware
from uwb_mitigation.measurement import (
    Cir,
    CorrectedColumns,
    CorrectedRange,
    Origin,
    RangeColumns,
    RangeMeasurement,
    Status,
)
from uwb_mitigation.mitigation import passed_through
from uwb_mitigation.model.bundle import Bundle
from uwb_mitigation.offsets import NO_OFFSETS, Offsets


class FirmwareMitigation:
    """Corrects ranges with one bundle as `Mitigation` does, to the same bits, by the firmware. A `Backend`.

    Raises:
        MissingDependencyError: there is no C compiler, or the firmware's sources are not installed.
        ModelError: the firmware cannot run the bundle's network.
        UwbMitigationError: the sources do not compile.
    """

    def __init__(self, bundle: Bundle, offsets: Offsets = NO_OFFSETS) -> None:
        self.bundle = bundle
        self.offsets = offsets
        # Once loaded, the library needs its file no more.
        with tempfile.TemporaryDirectory(prefix="uwb_firmware_backend_") as name:
            folder = Path(name)
            export_bundle(bundle, folder)
            self._firmware = HostFirmware(folder, folder)

    def correct(self, measurement: RangeMeasurement) -> CorrectedRange:
        """As `Mitigation.correct`."""
        range_m, correction_m, variance_m2, status = self._firmware.correct(
            measurement.range_m, measurement.cir, self.offsets.of(measurement.tag_id, measurement.anchor_id)
        )
        corrected = passed_through(self.bundle, measurement, Status(status), self.offsets)
        if status != Status.OK:
            return corrected
        return replace(corrected, range_m=range_m, correction_m=correction_m, variance_m2=variance_m2)

    def correct_columns(self, ranges: RangeColumns) -> tuple[NDArray[np.intp], CorrectedColumns]:
        """As `Backend` says; the rows are those with the status OK."""
        offset = self.offsets.of_columns(ranges.tag_id, ranges.anchor_id)
        answers = [
            self._firmware.correct(float(ranges.range_m[row]), _cir(ranges, row), float(offset[row]))
            for row in range(len(ranges))
        ]
        rows = [row for row, (*_, status) in enumerate(answers) if status == Status.OK]
        range_m, correction_m, variance_m2 = (
            np.array([answers[row][:3] for row in rows], np.float32).reshape(-1, 3).T
        )
        status = np.full(len(rows), Status.OK, np.uint8)
        return np.array(rows, np.intp), CorrectedColumns(
            range_m, correction_m, variance_m2, status, Origin.HOST, self.bundle.model_id
        )


def _cir(ranges: RangeColumns, row: int) -> Cir:
    return Cir(
        samples=ranges.samples[row],
        encoding=ranges.encoding,
        start_index=int(ranges.start_index[row]),
        first_path_index=float(ranges.first_path_index[row]),
        scale=float(ranges.scale[row]),
        preamble_count=int(ranges.preamble_count[row]),
        rx_power_dbm=float(ranges.rx_power_dbm[row]),
        first_path_power_dbm=float(ranges.first_path_power_dbm[row]),
    )
