"""Build description, as ament_python expects it."""

import os
import shlex
import sys
from pathlib import Path

from setuptools import find_packages, setup
from setuptools.command.build_py import build_py
from setuptools.command.develop import develop

PACKAGE = "uwb_mitigation"
REPOSITORY = "https://github.com/uwb-mitigation/uwb_mitigation"


def files(folder: str, *patterns: str) -> list[str]:
    return sorted(str(path) for pattern in patterns for path in Path(folder).glob(pattern))


def required(part: str) -> list[str]:
    """Return the requirements in requirements/PART.in, without those of included files (separate extras)."""
    lines = Path("requirements", f"{part}.in").read_text(encoding="utf-8").splitlines()
    return [line for line in lines if line and not line.startswith(("#", "-"))]


def check_messages() -> None:
    """Exit if `colcon build` does not find the message packages: it does not search inside packages."""
    prefixes = [Path(entry) for entry in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep) if entry]
    messages = Path("share", f"{PACKAGE}_msgs", "package.xml")
    if os.environ.get("COLCON") == "1" and not any((prefix / messages).is_file() for prefix in prefixes):
        folder = shlex.quote(str(Path("msg_defs").resolve()))
        sys.exit(f"{PACKAGE}_msgs is missing; run: colcon build --base-paths . {folder}")


class Build(build_py):
    """Build step of `colcon build` and pip."""

    def run(self) -> None:
        check_messages()
        super().run()


class Develop(develop):
    """Build step of `colcon build --symlink-install`."""

    def run(self) -> None:
        check_messages()
        super().run()


# pip installs the command into the environment's bin; a colcon workspace has it only in lib.
COMMAND = (
    []
    if {"bdist_wheel", "dist_info", "editable_wheel"} & set(sys.argv)
    else [("bin", ["resource/bin/uwb-mitigation"])]
)

# A shebang cannot contain a space: if Python's path has one, the scripts use python3 from PATH.
SCRIPTS = {"build_scripts": {"executable": "/usr/bin/env python3"}} if " " in sys.executable else {}

setup(
    name=PACKAGE,
    cmdclass={"build_py": Build, "develop": Develop},
    options=SCRIPTS,
    version="0.1.0",
    packages=find_packages(include=[PACKAGE, f"{PACKAGE}.*"]),
    package_data={
        PACKAGE: [
            "py.typed",
            "models/*",
            "types/ros/interfaces/*.msg",
            "recordings/mappings/*.yaml",
            "viewer/templates/*",
        ]
    },
    data_files=[
        *COMMAND,
        ("share/ament_index/resource_index/packages", [f"resource/{PACKAGE}"]),
        (f"share/{PACKAGE}", ["package.xml"]),
        # Files that `doctor` names if a dependency is missing.
        (f"share/{PACKAGE}/requirements", files("requirements", "ros_*.txt")),
        (f"share/{PACKAGE}/launch", files("launch", "*.launch.py")),
        # Settings for other packages, which docs/guides/robot_integration.md describes.
        (f"share/{PACKAGE}/config", files("config", "*")),
        (f"share/{PACKAGE}/params", files("params", "*.yaml")),
        (f"share/{PACKAGE}/rviz", files("rviz", "*.rviz")),
        (f"share/{PACKAGE}/foxglove", files("foxglove", "*.json")),
        (f"share/{PACKAGE}/plotjuggler", files("plotjuggler", "*.xml")),
        (f"share/{PACKAGE}/udev", files("udev", "*.rules")),
        (f"share/{PACKAGE}/models", files("models", "*.onnx", "*.md")),
        # Sources that `backend:=firmware` compiles; the boards and the sketch need a checkout.
        (f"share/{PACKAGE}/firmware/src", files("firmware/src", "*.c", "*.h")),
        (f"share/{PACKAGE}/firmware/native", files("firmware/native", "*.c")),
    ],
    install_requires=required("runtime"),
    extras_require={
        "training": [*required("training"), "torch"],
        "viewer": required("viewer"),
        "dask": required("dask"),
        "formats": required("formats"),
        "spi": required("spi"),
        # colcon reads this to detect that pytest runs the tests.
        "test": ["pytest"],
    },
    zip_safe=False,
    author="The uwb_mitigation maintainers",
    maintainer="The uwb_mitigation maintainers",
    maintainer_email="uwb-mitigation@users.noreply.github.com",
    url=REPOSITORY,
    project_urls={"Source": REPOSITORY, "Issues": f"{REPOSITORY}/issues"},
    description="Removes the range error of ultra-wideband ranging with a small int8 network.",
    long_description=Path("README.md").read_text(encoding="utf-8"),
    long_description_content_type="text/markdown",
    license="Apache-2.0",
    python_requires=">=3.10",
    entry_points={
        "console_scripts": [
            "driver = uwb_mitigation.commands.entry:driver",
            "mitigator = uwb_mitigation.commands.entry:mitigator",
            "locator = uwb_mitigation.commands.entry:locator",
            "pipeline = uwb_mitigation.commands.entry:pipeline",
            "monitor = uwb_mitigation.commands.entry:monitor",
            "px4 = uwb_mitigation.commands.entry:px4",
            "viewer = uwb_mitigation.commands.entry:viewer",
            "uwb-mitigation = uwb_mitigation.commands.entry:command_line",
        ],
    },
)
