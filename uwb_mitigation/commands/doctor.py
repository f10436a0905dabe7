"""`uwb-mitigation doctor`."""

from __future__ import annotations

from dataclasses import asdict

from rich.markup import escape
from rich.table import Column, Table

from uwb_mitigation.commands import console
from uwb_mitigation.commands.console import JsonOption
from uwb_mitigation.errors import UwbMitigationError

_STYLES = {"ok": "green", "broken": "red"}


def doctor(json: JsonOption = None) -> None:
    """Look at what is installed, and say how to mend it.

    The exit code is 1 where something is broken; what is optional never is.
    """
    from uwb_mitigation.installation import State, examine

    findings = list(examine())
    broken = [finding for finding in findings if finding.state is State.BROKEN]
    table = Table("", "state", Column(overflow="fold"))
    for finding in findings:
        style = _STYLES.get(finding.state.value, "yellow")
        table.add_row(finding.name, f"[{style}]{finding.state.value}[/]", escape(finding.detail))
    console.out.print(table)
    for fix in dict.fromkeys(finding.fix for finding in findings if finding.fix):
        names = ", ".join(finding.name for finding in findings if finding.fix == fix)
        # A line of its own, whole: it is to be copied.
        console.out.print(f"{names}:\n    {fix}", markup=False, highlight=False, soft_wrap=True)
    console.write_json(json, {"ok": not broken, "findings": [asdict(finding) for finding in findings]})
    if broken:
        raise UwbMitigationError(
            "1 thing is broken" if len(broken) == 1 else f"{len(broken)} things are broken"
        )
    console.out.print("all is well")
