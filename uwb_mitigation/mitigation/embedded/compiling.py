"""Find the firmware's sources and the native C compiler; run compilers and other tools."""

from __future__ import annotations

import atexit
import ctypes
import functools
import os
import re
import shlex
import shutil
import subprocess
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path

from uwb_mitigation.errors import MissingDependencyError, UwbMitigationError
from uwb_mitigation.mitigation.model.shipped import shared_folders

Signatures = Mapping[str, tuple[object, tuple[object, ...]]]
WARNINGS = ("-Wall", "-Wextra", "-Wconversion", "-Wpedantic", "-Werror")

CORRECTION, BOARD = "uwb_[cknp]*.c", "uwb_[bcfklnp]*.c"
"""Sources that correct ranges (correct, kernels, network, preprocess), and these with the protocol of a board. The others drive radios."""


def firmware_folder() -> Path:
    """Return the folder `firmware/`: complete in a checkout, an installation contains only the sources.

    Raises:
        MissingDependencyError: it does not exist; the message lists the searched folders.
    """
    folders = shared_folders("firmware")
    for folder in folders:
        if (folder / "src" / "uwb_mitigation.h").is_file():
            return folder
    raise MissingDependencyError(
        "the sources of the firmware are not installed",
        where=", ".join(map(str, folders)),
        valid="install the package again",
    )


def c_compiler() -> tuple[str, ...]:
    """Return the command of the C compiler: CC with its options as in make, or cc, or gcc.

    Raises:
        MissingDependencyError: no C compiler is installed.
    """
    words = tuple(shlex.split(os.environ.get("CC", ""))) or ("cc" if shutil.which("cc") else "gcc",)
    if shutil.which(words[0]) is None:
        raise MissingDependencyError(f"C compiler {words[0]} not found", valid="apt install gcc, or set CC")
    return words


def compile_objects(
    compiler: tuple[str, ...], options: tuple[str, ...], sources: tuple[Path, ...]
) -> tuple[str, ...]:
    """Compile sources, each once per process, because many models are linked with the same library."""
    return tuple(_compile_object(compiler, options, source) for source in sources)


@functools.cache
def _compile_object(compiler: tuple[str, ...], options: tuple[str, ...], source: Path) -> str:
    folder = tempfile.mkdtemp(prefix="uwb_firmware_object_")
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    output = f"{folder}/{source.name}.o"
    run_tool([*compiler, *options, "-c", str(source), "-o", output])
    return output


def load_library(prefix: str, objects: Sequence[str], signatures: Signatures) -> ctypes.CDLL:
    """Link object files into a shared library and load it into this process.

    Args:
        prefix: prefix of the function names.
        objects: paths of the object files.
        signatures: result and arguments of the functions, {name without prefix: (result, arguments)}.

    Raises:
        UwbMitigationError: the objects cannot be linked.
    """
    folder = tempfile.mkdtemp(prefix=f"uwb_{prefix}")
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    path = f"{folder}/{prefix}library.so"
    run_tool([*c_compiler(), "-shared", *objects, "-o", path, "-lm", "-lpthread"])
    return declare(ctypes.CDLL(path), prefix, signatures)


def declare(library: ctypes.CDLL, prefix: str, signatures: Signatures) -> ctypes.CDLL:
    """Set result and arguments of a library's functions, see `load_library`; return the library."""
    for name, (result, arguments) in signatures.items():
        function = getattr(library, f"{prefix}{name}")
        function.restype, function.argtypes = result, arguments
    return library


def run_tool(command: Sequence[str], timeout_s: float = 300, folder: Path | None = None) -> str:
    """Run a tool, in `folder`, and return its standard output.

    Raises:
        UwbMitigationError: it fails or times out; the message contains its first error line.
    """
    try:
        process = subprocess.run(
            command,
            capture_output=True,
            text=True,
            timeout=timeout_s,
            check=False,
            stdin=subprocess.DEVNULL,
            cwd=folder,
        )
    except subprocess.TimeoutExpired as error:
        raise UwbMitigationError(f"timed out after {timeout_s} s", where=command[0]) from error
    except OSError as error:
        raise MissingDependencyError(f"cannot be run: {error.strerror}", where=command[0]) from error
    if process.returncode:
        lines = process.stderr.splitlines()
        error_lines = (line for line in lines if re.search("error:|undefined reference", line))
        reason = next(error_lines, lines[-1] if lines else "no message")
        raise UwbMitigationError(f"exit {process.returncode}: {reason}", where=Path(command[0]).name)
    return process.stdout
