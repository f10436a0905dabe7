"""The fuzz targets of the link, run briefly with bytes from Hypothesis."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

_spec = importlib.util.spec_from_file_location(
    "link_targets", Path(__file__).parent / "fuzz" / "link_targets.py"
)
link_targets = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(link_targets)


@pytest.mark.parametrize("name", link_targets.TARGETS)
def test_arbitrary_bytes_do_not_break_the_target(name):
    target = link_targets.TARGETS[name]

    @settings(max_examples=300)
    @given(st.binary(max_size=400))
    def run(data: bytes) -> None:
        target(data)

    run()


def test_session_target_reaches_a_connection():
    # kind 1, no pause, then model, boot and request of a HELLO, and its sequence.
    script = link_targets.Script(bytes([1, 0, 0, 7, 7, 0, 0]))
    kind = script.number(1)
    script.number(2)
    host = link_targets.BoardSession()
    host.receive(link_targets._made_up(kind, script), 0, 0)

    assert host.state is link_targets.LinkState.READY
