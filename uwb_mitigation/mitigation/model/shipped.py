"""Find the models and other files of the installed package."""

from __future__ import annotations

import os
import sys
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Literal, overload

from uwb_mitigation.errors import ModelError, did_you_mean

if TYPE_CHECKING:
    # `doctor` must work without NumPy.
    from uwb_mitigation.mitigation.model.bundle import Bundle
    from uwb_mitigation.mitigation.preprocessing import Scaling

AUTO = "auto"
"""Name of the choice of a model for each range, see `choose_model`."""

DEFAULT, AMPLITUDE = "universal", "universal_amplitude"
"""Models for unknown sites and boards, with and without preamble counts."""

AUTOMATIC = (DEFAULT, AMPLITUDE, "dw3000_sts")
"""Models that are chosen automatically; of two that fit, the first."""

SHIPPED = (*AUTOMATIC, "evk1000_apartment")
"""All models; the last one, an example of a surveyed site, is used only if it is named."""

_SHARE = Path("share", "uwb_mitigation")


@overload
def load_model(named: Literal["auto"] | None = None) -> tuple[Bundle, ...]: ...  # type: ignore[overload-overlap]


@overload
def load_model(named: str | Path) -> Bundle: ...


def load_model(named: str | Path | None = None) -> Bundle | tuple[Bundle, ...]:
    """Load a model: a file, or the name of a shipped one (`SHIPPED`).

    For `auto` or None, load the shipped models from which `Mitigation` chooses one for each range. All are loaded, so that
    no live range waits for one (7 ms each) and a damaged file is reported at once.

    Raises:
        ModelError: there is no such model or file, it is damaged, or `named` is neither a name nor a path.
    """
    from uwb_mitigation.mitigation.model.bundle import load_bundle

    if not isinstance(named, str | Path | None):
        raise ModelError(f"model {named!r:.60}", valid=f"a path, {AUTO}, or one of {', '.join(SHIPPED)}")
    if not named or str(named) in (AUTO, "."):
        return tuple(load_bundle(shipped_model_path(name)) for name in AUTOMATIC)
    return load_bundle(model_path(named))


def default_model_path(scaling: Scaling | None = None) -> Path:
    """Return the path of the default model for inputs with a scaling (default: preamble); see `shipped_model_path`."""
    return shipped_model_path(AMPLITUDE if scaling is not None and scaling.value == "max" else DEFAULT)


def model_path(named: str | Path | None) -> Path:
    """Return the path of a bundle: a file, or one of `SHIPPED`; the default for None.

    Raises:
        ModelError: there is no such shipped model or file; the message lists the shipped ones.
    """
    if not named or str(named) == ".":
        return default_model_path()
    if str(named) in SHIPPED:
        return shipped_model_path(str(named))
    path = Path(named).expanduser()
    if not path.exists():
        raise ModelError(
            "neither a file nor a shipped model",
            where=named,
            valid=f"shipped models: {', '.join(SHIPPED)}",
            suggestion=did_you_mean(path.stem, SHIPPED),
        )
    return path


def shipped_model_path(name: str) -> Path:
    """Return the path of one of `SHIPPED`, which are data of the package.

    Raises:
        ModelError: it is not installed.
    """
    path = Path(str(files("uwb_mitigation"))) / "models" / f"{name}.onnx"
    if not path.is_file():
        valid = "install the package again, or give the path of a model"
        raise ModelError(f"the shipped model {name} is not installed", where=path.parent, valid=valid)
    return path


def shared_folders(name: str) -> list[Path]:
    """Return possible paths of the shared folder `name`: in a checkout, this installation and sourced workspaces."""
    package = Path(__file__).resolve().parents[2]
    folders = [package.parent / name]
    # `pip install --target`, lib/python3.x/site-packages, or Debian's local/lib/python3.x/dist-packages.
    folders += [package.parents[up] / _SHARE / name for up in (0, 3, 4) if up < len(package.parents)]
    prefixes = os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)
    folders += [Path(prefix) / _SHARE / name for prefix in prefixes if prefix]
    folders.append(Path(sys.prefix) / _SHARE / name)
    return list(dict.fromkeys(folders))
