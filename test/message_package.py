"""Build a ROS message package in a test, as a user's workspace does."""

from __future__ import annotations

import os
import subprocess
import sys
import sysconfig
from collections.abc import Mapping
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


def build(name: str, messages: Mapping[str, str], folder: Path) -> dict[str, str]:
    """Generate, compile and install a package; return the environment of a process that uses it.

    Args:
        name: Name of the package.
        messages: {name: text of the .msg file}.
        folder: Where to build and install it.
    """
    source, prefix = folder / "source", folder / "install"
    (source / "msg").mkdir(parents=True)
    for message, text in messages.items():
        (source / "msg" / f"{message}.msg").write_text(text)
    files = " ".join(f'"msg/{message}.msg"' for message in messages)
    (source / "CMakeLists.txt").write_text(
        f"cmake_minimum_required(VERSION 3.16)\nproject({name})\nfind_package(ament_cmake REQUIRED)\n"
        "find_package(rosidl_default_generators REQUIRED)\nfind_package(std_msgs REQUIRED)\n"
        f"rosidl_generate_interfaces(${{PROJECT_NAME}} {files} DEPENDENCIES std_msgs)\nament_package()\n"
    )
    (source / "package.xml").write_text(
        f'<package format="3"><name>{name}</name><version>0.0.0</version><description>test</description>'
        '<maintainer email="a@example.com">a</maintainer><license>none</license>'
        "<buildtool_depend>rosidl_default_generators</buildtool_depend><depend>std_msgs</depend>"
        "<member_of_group>rosidl_interface_packages</member_of_group></package>"
    )
    environment = os.environ | {
        "AMENT_PREFIX_PATH": os.environ.get("AMENT_PREFIX_PATH", sys.prefix),
        "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}",
    }
    options = [
        f"-DCMAKE_INSTALL_PREFIX={prefix}",
        f"-DPython3_EXECUTABLE={sys.executable}",
        f"-DCMAKE_PROJECT_INCLUDE={ROOT / 'cmake' / 'ros_wheels.cmake'}",
        *("-DBUILD_TESTING=OFF", "-DCMAKE_BUILD_TYPE=Debug"),
    ]
    for command in (
        ["cmake", "-S", str(source), "-B", str(folder / "build"), *options],
        ["cmake", "--build", str(folder / "build"), "--target", "install", "--parallel", "2"],
    ):
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]
    version = f"python{sysconfig.get_python_version()}"
    (packages,) = prefix.glob(f"**/{version}/site-packages")
    return {
        "AMENT_PREFIX_PATH": f"{prefix}:{environment['AMENT_PREFIX_PATH']}",
        "PYTHONPATH": f"{packages}:{os.environ.get('PYTHONPATH', '')}".rstrip(":"),
        "LD_LIBRARY_PATH": f"{prefix / 'lib'}:{os.environ.get('LD_LIBRARY_PATH', '')}".rstrip(":"),
    }
