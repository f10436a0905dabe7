"""The executables. Loading ROS and ONNX Runtime takes a second: signals are caught before it begins."""

from __future__ import annotations

from uwb_mitigation.nodes.signals import stop_event


def driver() -> None:
    stop_event()
    from uwb_mitigation.nodes.driver import main

    main()


def mitigator() -> None:
    stop_event()
    from uwb_mitigation.nodes.mitigator import main

    main()


def pipeline() -> None:
    stop_event()
    from uwb_mitigation.nodes.pipeline import main

    main()
