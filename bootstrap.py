"""Sets up `.venv`: a virtual environment that is also a ROS 2 prefix. Standard library only.

    python3 bootstrap.py [--keep-python] [run | develop | docs]

With `--keep-python` an environment that is there keeps the Python that it was made with. `run` is what the nodes and the command line need; `develop` adds the test tools and torch, `docs` adds
what builds the documentation. Each step leaves a stamp of its inputs and is skipped while they have not
changed, so a second run takes a fraction of a second. An environment that has to be made anew replaces the old one
only when it is complete. Where /opt/ros/jazzy (or $ROS_PREFIX) exists it is
used; elsewhere the ROS wheels from PyPI are installed. Nothing outside the checkout is written, and no
root is needed.
"""

from __future__ import annotations

import hashlib
import os
import platform
import shlex
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

ROOT = Path(__file__).resolve().parent
VENV = ROOT / ".venv"
BEFORE = ROOT / ".venv.before"
STAMPS = VENV / "stamps"
ROS_PREFIX = Path(os.environ.get("ROS_PREFIX", "/opt/ros/jazzy"))
SYSTEM_ROS = (ROS_PREFIX / "setup.sh").is_file()
# Those of jazzy/ go with the numpy, protobuf and PyYAML of Ubuntu 24.04.
LOCKS = ROOT / "requirements" / "jazzy" if SYSTEM_ROS else ROOT / "requirements"
GOALS = ("run", "develop", "docs")
PYTHONS = ((3, 10), (3, 13))
TORCH = "2.13.0"
TORCH_CPU_INDEX = "https://download.pytorch.org/whl/cpu"


class SetupError(Exception):
    """A step cannot be done; the text says why and what to do."""


def main(words: list[str]) -> None:
    goals = [word for word in words if word != "--keep-python"]
    if len(goals) > 1 or not set(goals) <= set(GOALS):
        raise SetupError(f"{' '.join(goals)}: no such goal; valid is one of {', '.join(GOALS)}")
    if "--keep-python" in words:
        continue_with(python_of_environment(), goals)
    check_tools()
    with restored_on_failure():
        set_up(goals[0] if goals else GOALS[0])


def set_up(goal: str) -> None:
    requirements = [LOCKS / "runtime.txt"]
    if not SYSTEM_ROS:
        requirements.insert(0, LOCKS / "ros.txt")
    step("environment", [str(ROOT), sys.version, str(SYSTEM_ROS)], create_environment)
    step("packages", requirements, lambda: install(requirements))
    step("messages", [ROOT / "msg_defs", ROOT / "cmake"], build_messages)
    step("package", [ROOT / name for name in ("setup.py", "setup.cfg")], install_package)
    if goal == "develop":
        tools = [LOCKS / "develop.txt", LOCKS / "training.txt"]
        step("tools", tools, lambda: install(tools))
        step("torch", [TORCH], install_torch)
    if goal == "docs":
        documentation = [LOCKS / "docs.txt"]
        step("documentation", documentation, lambda: install(documentation))
    # Whatever the other steps have brought.
    step("bytecode", sorted(set(STAMPS.iterdir()) - {STAMPS / "bytecode"}), compile_all)


def python_of_environment() -> str:
    """The Python that the environment was made with; this one, where there is none or it is gone."""
    try:
        lines = (VENV / "pyvenv.cfg").read_text(encoding="utf-8").splitlines()
    except OSError:
        return sys.executable
    settings = dict(line.split(" = ", 1) for line in lines if " = " in line)
    python = settings.get("executable") or str(Path(settings.get("home", ""), "python3"))
    return python if os.access(python, os.X_OK) else sys.executable


def continue_with(python: str, goals: list[str]) -> None:
    """Go on as `python`, unless this is it."""
    if os.path.realpath(python) != os.path.realpath(sys.executable):
        os.execv(python, [python, __file__, *goals])


@contextmanager
def restored_on_failure() -> Iterator[None]:
    """Put the environment of before back where a new one cannot be made, as without a network."""
    if BEFORE.is_dir():  # what an earlier run was ended in, by force
        shutil.rmtree(VENV, ignore_errors=True)
        BEFORE.rename(VENV)
    try:
        yield
    except BaseException:
        if BEFORE.is_dir():
            shutil.rmtree(VENV, ignore_errors=True)
            BEFORE.rename(VENV)
            print("setup: the environment is again what it was before", file=sys.stderr)
        raise
    shutil.rmtree(BEFORE, ignore_errors=True)


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
    # Whatever follows was built upon this step, so its stamps fall with it; those of an environment stay in it.
    order = ["packages", "messages", "package", "tools", "torch", "documentation"]
    for later in order[order.index(name) :] if name in order else ():
        (STAMPS / later).unlink(missing_ok=True)
    action()
    STAMPS.mkdir(parents=True, exist_ok=True)
    stamp.write_text(digest.hexdigest())


def check_tools() -> None:
    """Refuse a processor without ROS wheels; name every missing tool at once, with the line that installs it."""
    machine = platform.machine()
    if not SYSTEM_ROS and machine not in ("x86_64", "AMD64"):
        raise SetupError(
            f"the ROS 2 wheels exist for x86-64 only, and this is {machine}. "
            f"Install ROS 2 Jazzy, so that {ROS_PREFIX}/setup.sh exists, or set ROS_PREFIX"
        )
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
    options = ["--system-site-packages"] if SYSTEM_ROS else []
    if VENV.is_dir():
        VENV.rename(BEFORE)
    run([sys.executable, "-m", "venv", *options, str(VENV)])
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
    # ROS's macros take neither an apostrophe nor a letter beyond ASCII in a path: the checkout is given one without.
    with tempfile.TemporaryDirectory(prefix="uwb_messages_") as folder:
        checkout = Path(folder, "checkout")
        checkout.symlink_to(ROOT)
        build_messages_of(checkout, Path(folder, "build"))


def build_messages_of(checkout: Path, build: Path) -> None:
    environment = checkout / VENV.name
    variables = dict(os.environ)
    variables["PATH"] = f"{environment / 'bin'}{os.pathsep}{variables.get('PATH', '')}"
    prefixes = [str(environment)]
    if SYSTEM_ROS:
        variables = sourced_environment(variables)
        prefixes.append(variables.get("AMENT_PREFIX_PATH", str(ROS_PREFIX)))
    variables["AMENT_PREFIX_PATH"] = os.pathsep.join(prefixes)
    configure = [
        "cmake", "-S", str(checkout / "msg_defs"), "-B", str(build),
        f"-DCMAKE_INSTALL_PREFIX={environment}", "-DBUILD_TESTING=OFF", "-DCMAKE_BUILD_TYPE=Release",
        f"-DPython3_EXECUTABLE={environment / 'bin' / 'python'}",
        f"-DCMAKE_PROJECT_INCLUDE={checkout / 'cmake' / 'ros_wheels.cmake'}",
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


def compile_all() -> None:
    """Compile what was installed, on all processors: pip would on one, and Python at each start where it may write none.

    Where PYTHONDONTWRITEBYTECODE is set, as in many containers, a node would take twice as long to start, and torch
    seconds. What does not compile, such as a template, is nobody's to import.
    """
    python = str(VENV / "bin" / "python")
    find = "import sysconfig; print(sysconfig.get_path('purelib'))"
    packages = subprocess.run([python, "-c", find], capture_output=True, text=True, check=True).stdout.strip()
    compile_ = [python, "-m", "compileall", "-q", "-j", "0", "-x", r"site-packages/.*/tests?/"]
    subprocess.run(
        [*compile_, packages, str(ROOT / "uwb_mitigation")],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        check=False,
    )


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
