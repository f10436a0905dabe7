"""Writes `params/*.yaml` and `docs/parameters.md` from the nodes' parameter tables.

    python -m uwb_mitigation.nodes.parameter_files

A test holds the files and the tables together.
"""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from pathlib import Path

import yaml

from uwb_mitigation.nodes import driver, mitigator
from uwb_mitigation.nodes.parameters import Parameter

ROOT = Path(__file__).resolve().parent.parent.parent
TABLES = {"driver": driver.PARAMETERS, "mitigator": mitigator.PARAMETERS}


def parameter_file(node: str, table: Sequence[Parameter]) -> str:
    """A ROS parameter file that holds every parameter at its default, with its meaning."""
    lines = [f"# Parameters of the {node} node, at their defaults.", "/**:", "  ros__parameters:"]
    for row in table:
        lines += [f"    # {line}" for line in textwrap.wrap(f"{row.description} ({row.valid})", 100)]
        lines.append("    " + yaml.safe_dump({row.name: row.default}, default_flow_style=False).rstrip())
    return "\n".join(lines) + "\n"


def reference() -> str:
    """The parameter reference, one table a node."""
    lines = [
        "# Parameters",
        "",
        "Set with `--ros-args -p name:=value`, or in a parameter file such as those in `params/`.",
        "A value of the wrong type or out of its range is refused, at start-up and at set time; a parameter that no",
        "node knows is named in a warning. The node `pipeline` takes those of both nodes.",
    ]
    for node, table in TABLES.items():
        lines += [
            "",
            f"## `{node}`",
            "",
            "| name | default | unit | valid | changes live | meaning |",
            "|---|---|---|---|---|---|",
        ]
        for row in table:
            default = yaml.safe_dump(row.default, default_flow_style=True).removesuffix("...\n").strip()
            live = "yes" if row.live else "no"
            lines.append(
                f"| `{row.name}` | `{default}` | {row.unit or '-'} | {row.valid} | {live} | {row.description} |"
            )
    return "\n".join(lines) + "\n"


def files() -> dict[Path, str]:
    """Every generated file with its text."""
    texts = {ROOT / "params" / f"{node}.yaml": parameter_file(node, table) for node, table in TABLES.items()}
    texts[ROOT / "docs" / "parameters.md"] = reference()
    return texts


if __name__ == "__main__":
    for path, text in files().items():
        path.write_text(text, encoding="utf-8")
        print(path.relative_to(ROOT))
