"""The firmware's C, compiled for this computer, in the place of ONNX Runtime."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np

from uwb_mitigation.firmware_export.export import export_bundle
from uwb_mitigation.firmware_export.host import HostFirmware
from uwb_mitigation.measurement import Cir, CorrectedColumns, RangeColumns, Status
from uwb_mitigation.mitigation import Backend, passed_through
from uwb_mitigation.model.bundle import Bundle
from uwb_mitigation.offsets import NO_OFFSETS, Offsets


class FirmwareMitigation(Backend):
    """Corrects ranges with one bundle as `Mitigation` does, to the same bits, by the firmware.

    Raises:
        MissingDependencyError: there is no C compiler, or the firmware's sources are not installed.
        ModelError: the firmware cannot run the bundle's network.
        UwbMitigationError: the sources do not compile.
    """

    def __init__(self, bundle: Bundle, offsets: Offsets = NO_OFFSETS) -> None:
        self.bundle = bundle
        self.offsets = offsets
        # The loaded library does not need its file any more.
        with tempfile.TemporaryDirectory(prefix="uwb_firmware_backend_") as name:
            folder = Path(name)
            export_bundle(bundle, folder)
            self._firmware = HostFirmware(folder, folder)

    def correct_columns(self, ranges: RangeColumns) -> CorrectedColumns:
        """See `Backend`."""
        offset = self.offsets.of(ranges.tag_id, ranges.anchor_id)
        *values, status = zip(
            *(
                self._firmware.correct(float(ranges.range_m[row]), _cir(ranges, row), float(offset[row]))
                for row in range(len(ranges))
            ),
            strict=True,
        )
        found = passed_through(self.bundle, ranges, offset, np.array(status, np.uint8))
        is_corrected = found.status == Status.OK
        for column, computed in zip(
            (found.range_m, found.correction_m, found.variance_m2), values, strict=True
        ):
            column[is_corrected] = np.array(computed, np.float32)[is_corrected]
        return found


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
