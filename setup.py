"""Build description, as ament_python expects it."""

from pathlib import Path

from setuptools import find_packages, setup

PACKAGE = "uwb_mitigation"


def files(folder: str, *patterns: str) -> list[str]:
    return sorted(str(path) for pattern in patterns for path in Path(folder).glob(pattern))


setup(
    name=PACKAGE,
    version="0.1.0",
    packages=find_packages(include=[PACKAGE, f"{PACKAGE}.*"]),
    package_data={PACKAGE: ["py.typed", "interfaces/*.msg", "evaluation/templates/*.j2"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{PACKAGE}"]),
        (f"share/{PACKAGE}", ["package.xml"]),
        (f"share/{PACKAGE}/launch", files("launch", "*.launch.py")),
        (f"share/{PACKAGE}/params", files("params", "*.yaml")),
        (f"share/{PACKAGE}/udev", files("udev", "*.rules")),
        (f"share/{PACKAGE}/models", files("models", "*.onnx", "*.md")),
        # What `backend:=firmware` compiles; the boards and the sketch need a checkout.
        (f"share/{PACKAGE}/firmware/src", files("firmware/src", "*.c", "*.h")),
    ],
    install_requires=["setuptools"],
    # colcon looks here to tell that pytest runs the tests.
    extras_require={"test": ["pytest"]},
    zip_safe=False,
    author="uwb_mitigation maintainers",
    maintainer="uwb_mitigation maintainers",
    maintainer_email="maintainers@uwb-mitigation.example.org",
    description="Removes the range error of ultra-wideband ranging with a small int8 network.",
    license="Apache-2.0",
    python_requires=">=3.10",
    entry_points={
        "console_scripts": [
            "driver = uwb_mitigation.nodes.entry:driver",
            "mitigator = uwb_mitigation.nodes.entry:mitigator",
            "pipeline = uwb_mitigation.nodes.entry:pipeline",
            "monitor = uwb_mitigation.nodes.monitor:main",
            "uwb-mitigation = uwb_mitigation.cli:main",
        ],
    },
)
