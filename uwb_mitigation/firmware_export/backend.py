"""The firmware's C, compiled for this computer, in the place of ONNX Runtime."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from uwb_mitigation.firmware_export.export import export_bundle
from uwb_mitigation.firmware_export.host import HostFirmware
from uwb_mitigation.measurement import CorrectedRange, RangeMeasurement, Status
from uwb_mitigation.mitigation import Mitigation
from uwb_mitigation.model.bundle import Bundle


class FirmwareMitigation(Mitigation):
    """`Mitigation` whose single and batched corrections are computed by the firmware, to the same bits.

    Raises:
        MissingDependencyError: there is no C compiler, or the firmware's sources are not installed.
        ModelError: the firmware cannot run the bundle's network.
        UwbMitigationError: the sources do not compile.
    """

    def __init__(self, bundle: Bundle) -> None:
        super().__init__(bundle)
        # Once loaded, the library needs its file no more.
        with tempfile.TemporaryDirectory(prefix="uwb_firmware_backend_") as name:
            folder = Path(name)
            export_bundle(bundle, folder)
            self._firmware = HostFirmware(folder, folder)

    def correct(self, measurement: RangeMeasurement) -> CorrectedRange:
        """As `Mitigation.correct`."""
        range_m, correction_m, variance_m2, status = self._firmware.correct(
            measurement.range_m, measurement.cir
        )
        corrected = self._passed(measurement, Status(status))
        if status != Status.OK:
            return corrected
        return replace(corrected, range_m=range_m, correction_m=correction_m, variance_m2=variance_m2)

    def correct_batch(self, measurements: Sequence[RangeMeasurement]) -> list[CorrectedRange]:
        """As `Mitigation.correct_batch`."""
        return [self.correct(measurement) for measurement in measurements]
