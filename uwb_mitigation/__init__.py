"""Correct the range error of ultra-wideband (UWB) radios, and estimate positions.

    from uwb_mitigation import Mitigation, load_model, open_recording

    mitigation = Mitigation(load_model(), offsets=0.22)
    for record in open_recording("drive.mcap"):
        print(mitigation.correct(record.measurement).range_m)

The names in `__all__` are the public API and remain stable; everything else is internal. Importing this package needs
neither ROS nor PyTorch nor pandas: a name is imported when it is used.
"""

from __future__ import annotations

import importlib
import os
from typing import TYPE_CHECKING, Any

from uwb_mitigation.files import VERSION

if TYPE_CHECKING:
    from uwb_mitigation.calibration.site import SiteCalibration as SiteCalibration
    from uwb_mitigation.calibration.site import calibrate as calibrate
    from uwb_mitigation.commands.offline.tracks import Tracks as Tracks
    from uwb_mitigation.commands.offline.tracks import track as track
    from uwb_mitigation.errors import UwbMitigationError as UwbMitigationError
    from uwb_mitigation.mitigation.correction import Mitigation as Mitigation
    from uwb_mitigation.mitigation.model.shipped import load_model as load_model
    from uwb_mitigation.positioning.tag_locator import TagLocator as TagLocator
    from uwb_mitigation.recordings.dataframe import to_dataframe as to_dataframe
    from uwb_mitigation.recordings.formats import open_recording as open_recording
    from uwb_mitigation.types.anchors import Anchor as Anchor
    from uwb_mitigation.types.anchors import AnchorMap as AnchorMap
    from uwb_mitigation.types.anchors import load_anchors as load_anchors
    from uwb_mitigation.types.measurement import Cir as Cir
    from uwb_mitigation.types.measurement import CorrectedRange as CorrectedRange
    from uwb_mitigation.types.measurement import Encoding as Encoding
    from uwb_mitigation.types.measurement import RadioType as RadioType
    from uwb_mitigation.types.measurement import RangeMeasurement as RangeMeasurement
    from uwb_mitigation.types.measurement import Record as Record
    from uwb_mitigation.types.measurement import Segment as Segment
    from uwb_mitigation.types.measurement import Status as Status
    from uwb_mitigation.types.measurement import Truth as Truth
    from uwb_mitigation.types.offsets import Offsets as Offsets
    from uwb_mitigation.types.tracks import Estimate as Estimate

__version__ = VERSION

# ONNX Runtime reads this when it is imported. By default it stores a device id in ~/.cache and sends usage data to Microsoft.
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")

_MODULES = {
    name: module
    for module, names in {
        "calibration.site": ("SiteCalibration", "calibrate"),
        "commands.offline.tracks": ("Tracks", "track"),
        "errors": ("UwbMitigationError",),
        "mitigation.correction": ("Mitigation",),
        "mitigation.model.shipped": ("load_model",),
        "positioning.tag_locator": ("TagLocator",),
        "recordings.dataframe": ("to_dataframe",),
        "recordings.formats": ("open_recording",),
        "types.anchors": ("Anchor", "AnchorMap", "load_anchors"),
        "types.measurement": (
            *("Cir", "CorrectedRange", "Encoding", "RadioType", "RangeMeasurement", "Record"),
            *("Segment", "Status", "Truth"),
        ),
        "types.offsets": ("Offsets",),
        "types.tracks": ("Estimate",),
    }.items()
    for name in names
}
"""Modules of the lazy names."""

__all__ = list(_MODULES)


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(f"{__name__}.{_MODULES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
