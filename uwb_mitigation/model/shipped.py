"""Finds the models, and other files, that ship with the package, wherever it is installed."""

from __future__ import annotations

import os
import sys
from pathlib import Path

from uwb_mitigation.errors import ModelError

SHIPPED = "evk1000_apartment.onnx"
SIMULATED = "simulated_flat.onnx"
_SHARE = Path("share", "uwb_mitigation")


def default_model_path() -> Path:
    """The shipped model: of a source checkout, of this installation, or of a sourced ROS workspace.

    Raises:
        ModelError: it is in none of these; the message lists them.
    """
    return _find(SHIPPED)


def simulated_model_path() -> Path:
    """The model that was trained in the simulator alone, to start from with few configurations: as above."""
    return _find(SIMULATED)


def _find(name: str) -> Path:
    candidates = [folder / name for folder in shared_folders("models")]
    for candidate in candidates:
        if candidate.is_file():
            return candidate
    raise ModelError(
        f"the shipped model {name} is not installed",
        where=", ".join(str(candidate.parent) for candidate in candidates),
        valid="install the package again, or name a model",
    )


def shared_folders(name: str) -> list[Path]:
    """Where the package's shared folder `name` may be: in a checkout, in this installation, in sourced workspaces."""
    package = Path(__file__).resolve().parent.parent
    folders = [package.parent / name]
    # lib/python3.x/site-packages/uwb_mitigation, or Debian's local/lib/python3.x/dist-packages.
    folders += [prefix / _SHARE / name for prefix in list(package.parents)[3:5]]
    prefixes = os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)
    folders += [Path(prefix) / _SHARE / name for prefix in prefixes if prefix]
    folders.append(Path(sys.prefix) / _SHARE / name)
    return list(dict.fromkeys(folders))
