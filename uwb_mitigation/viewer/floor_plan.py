"""Read a floor plan as `map_server` of Nav2 does: a YAML file and an image."""

from __future__ import annotations

import base64
import io
import math
import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import yaml
from PIL import Image

from uwb_mitigation.errors import ParameterError
from uwb_mitigation.files import read_bounded

MAX_TEXT, MAX_BYTES, MAX_PIXELS = 1 << 16, 1 << 26, 50_000_000
MAX_SIDE = 1200
"""Maximum width and height of the displayed image, pixels."""
VALID = "a map_server file: image, resolution (m per pixel), origin [x, y, yaw]"


@dataclass(frozen=True, slots=True)
class MapImage:
    """A floor plan for a web page.

    Attributes:
        url: PNG image as a data URL; walls are grey, everything else is transparent.
        x, y, yaw: lower left corner in the map, m, and rotation, rad. width, height: m.
    """

    url: str
    x: float
    y: float
    yaw: float
    width: float
    height: float


def load_floor_plan(path: Path) -> MapImage:
    """Read a floor plan.

    Raises:
        ParameterError: the YAML file or the image cannot be read or is invalid.
    """
    where = str(path)
    try:
        document = yaml.safe_load(read_bounded(path, MAX_TEXT, ParameterError, VALID))
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise ParameterError("not YAML", where=where, valid=VALID) from error
    try:
        name, resolution = str(document["image"]), float(document["resolution"])
        x, y, yaw = (float(value) for value in document["origin"])
        negated = bool(int(document.get("negate", 0)))
        threshold = float(document.get("occupied_thresh", 0.65))
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
        raise ParameterError(f"invalid fields ({error!r:.60})", where=where, valid=VALID) from error
    if not (1e-4 <= resolution <= 100.0 and max(abs(x), abs(y)) < 1e5 and math.isfinite(yaw)):
        raise ParameterError("implausible resolution or origin", where=where, valid=VALID)
    data = read_bounded(path.parent / name, MAX_BYTES, ParameterError, "a PGM or PNG image")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", Image.DecompressionBombWarning)
            image = Image.open(io.BytesIO(data))
            if image.width * image.height > MAX_PIXELS:
                raise ValueError("too many pixels")
            grey = image.convert("L")
    # Pillow raises various types for damaged images; UnidentifiedImageError is an OSError.
    except (OSError, ValueError, SyntaxError, Warning, Image.DecompressionBombError) as error:
        raise ParameterError(
            f"not a readable image: {error!s:.80}", where=str(path.parent / name), valid="PGM or PNG"
        ) from error
    width, height = grey.width * resolution, grey.height * resolution
    grey.thumbnail((MAX_SIDE, MAX_SIDE))
    value = np.asarray(grey, np.float64) / 255.0
    occupied = (value if negated else 1.0 - value) > threshold
    pixels = np.zeros((*occupied.shape, 4), np.uint8)
    pixels[occupied] = (128, 128, 128, 255)
    out = io.BytesIO()
    Image.fromarray(pixels).save(out, "PNG", optimize=True)
    url = "data:image/png;base64," + base64.b64encode(out.getvalue()).decode()
    return MapImage(url, x, y, yaw, width, height)
