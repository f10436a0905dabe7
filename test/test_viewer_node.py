"""The node `viewer` with a real driver, mitigator and locator: what the page shows is what they publish."""

import os
import re
import signal
import threading
import time
from pathlib import Path

import psutil
import pytest
import ros_harness
from browser import Browser
from geometry_msgs.msg import PoseWithCovarianceStamped
from lifecycle_msgs.msg import Transition
from uwb_mitigation_msgs.msg import RangeCorrected
from visualization_msgs.msg import MarkerArray

from benchmarks.equipment.page_clients import PageClients
from uwb_mitigation.nodes import markers
from uwb_mitigation.nodes.support import endpoints
from uwb_mitigation.types.anchors import Anchor, AnchorMap

pytestmark = pytest.mark.ros


def address(viewer: ros_harness.Process) -> str:
    """Return the URL of the page of a viewer that has started."""
    viewer.wait_for_output("the page is at")
    return re.search(r"the page is at (\S+)", viewer.output)[1]


def test_page_shows_published_messages_and_names_missing_nodes(ros: ros_harness.Ros, browser: Browser):
    published = ros.collect(RangeCorrected, "/uwb/range_corrected")
    anchors_out = ros.node.create_publisher(MarkerArray, "/uwb/anchors", endpoints.LATCHED)
    url = address(ros.start("viewer", "port:=0"))
    assert ros.node.count_subscribers("/uwb/range_raw") == 0, (
        "CIRs are not for the viewer while no page is open"
    )
    browser.open(url)
    browser.wait("the page", browser.ready)

    def shown(text: str) -> bool:
        return text in browser.text()

    browser.wait("what to start", lambda: shown("Start the driver and the mitigator"))
    # The driver waits for a first subscriber.
    driver = ros.start("driver", "source:=simulated", "simulated_rate:=40.0")
    browser.wait("what else to start", lambda: shown("Start the mitigator"))
    mitigator = ros.start("mitigator")

    def shows_published_ranges() -> bool:
        ros.spin_for(0.05)
        values = {round(message.range, 6) for message in published}
        column = browser.column("pairs", "corrected")
        return len(column) >= 2 and all(round(value, 6) in values for value in column)

    browser.wait("ranges as published", shows_published_ranges)
    ids = sorted({message.anchor_id for message in published})
    anchors = AnchorMap([Anchor(identity, (float(x), 0.5, 2.0)) for x, identity in enumerate(ids)])
    anchors_out.publish(MarkerArray(markers=markers.anchor_markers(anchors, "map", 0)))
    browser.wait("the anchors", lambda: sorted(map(int, browser.column("map", "id"))) == ids)
    browser.wait("a CIR", lambda: len(browser.column("cir", "magnitude")) > 100)
    browser.wait("diagnostics", lambda: shown("mitigator: ranges"))
    assert browser.run("return document.title").startswith("UWB ranges")
    for node in (driver, mitigator):
        node.signal(signal.SIGKILL)
    browser.wait(
        "no data", lambda: all("no data for" in status for status in browser.column("pairs", "status"))
    )
    browser.wait("STALE", lambda: shown("no diagnostics for"))
    browser.wait("no rates", lambda: set(browser.column("pairs", "rate")) == {0})


def test_anchor_markers_are_published_without_a_locator(ros: ros_harness.Ros, tmp_path: Path):
    anchors = tmp_path / "anchors.yaml"
    anchors.write_text("anchors:\n  - {id: 5, x: 1.0, y: 2.0, z: 3.0, name: door}\n")
    shown: list[MarkerArray] = []
    ros.node.create_subscription(MarkerArray, "/uwb/anchors", shown.append, endpoints.LATCHED)
    viewer = ros.start("viewer", "port:=0", f"anchors:={anchors}", "map_frame:=site")
    ros.spin_until(lambda: bool(shown))
    ball, name = shown[0].markers
    assert (ball.ns, ball.text, ball.header.frame_id) == ("anchors", "5", "site")
    assert (ball.pose.position.x, ball.pose.position.y, ball.pose.position.z) == (1.0, 2.0, 3.0)
    assert name.text == "5 (door)"
    threads = psutil.Process(viewer.pid).threads()
    assert len(threads) > 5, "the middleware's are among them"
    assert {os.getpriority(os.PRIO_PROCESS, thread.id) for thread in threads} == {min(os.nice(0) + 10, 19)}, (
        "ranges are corrected before they are drawn"
    )


def test_tag_topics_are_found_with_remapped_names(ros: ros_harness.Ros):
    viewer = ros.start(
        "viewer", "port:=0", arguments=("-r", "__ns:=/uwb", "-r", "/uwb/uwb/pose:=/robot/pose")
    )
    own = ros.node.create_publisher(PoseWithCovarianceStamped, "/uwb/uwb/tag_3/pose", 10)
    ros.spin_until(lambda: own.get_subscription_count() == 1 or viewer.exit_code() is not None)
    assert viewer.exit_code() is None, viewer.output
    ros.wait_for_subscribers("/robot/pose", 1)


def test_deactivated_viewer_unsubscribes_and_can_be_activated_again(ros: ros_harness.Ros):
    corrected = ros.node.create_publisher(RangeCorrected, "/uwb/range_corrected", 10)
    url = address(ros.start("viewer", "port:=0"))
    with PageClients(url, 1):
        ros.spin_until(lambda: ros.node.count_subscribers("/uwb/range_raw") == 1)
        assert ros.change_state("viewer", Transition.TRANSITION_DEACTIVATE)
        ros.spin_until(lambda: ros.node.count_subscribers("/uwb/range_raw") == 0)
    assert ros.change_state("viewer", Transition.TRANSITION_CLEANUP)
    ros.spin_until(lambda: corrected.get_subscription_count() == 0)
    assert ros.change_state("viewer", Transition.TRANSITION_CONFIGURE)
    assert ros.change_state("viewer", Transition.TRANSITION_ACTIVATE)
    ros.spin_until(lambda: corrected.get_subscription_count() == 1)
    for _ in range(20):
        corrected.publish(RangeCorrected(anchor_id=1, tag_id=2))
    ros.diagnosis("viewer", lambda status: status.message == "serving 0 pages")


def test_rates_and_losses_are_correct_at_1000_ranges_per_second(ros: ros_harness.Ros, browser: Browser):
    publisher = ros.node.create_publisher(RangeCorrected, "/uwb/range_corrected", 10_000)
    browser.open(address(ros.start("viewer", "port:=0")))
    browser.wait("the page", browser.ready)
    ros.spin_until(lambda: publisher.get_subscription_count() == 1)
    stop = threading.Event()

    def publish() -> None:
        message, began_s, number = RangeCorrected(range=4.0, range_raw=4.2), time.monotonic(), 0
        while not stop.wait(0.005):
            while number < 1000 * (time.monotonic() - began_s) and not stop.is_set():
                message.anchor_id, message.tag_id = number % 30, number // 30 % 5
                message.sequence = number
                # One range in ten of each pair was lost by the radio.
                if (number + number // 150) % 10 != 3:
                    stamp = number + 1_000_000
                    message.header.stamp.sec, message.header.stamp.nanosec = (
                        stamp // 1000,
                        stamp % 1000 * 1_000_000,
                    )
                    publisher.publish(message)
                number += 1

    thread = threading.Thread(target=publish)
    thread.start()
    try:

        def received() -> int:
            found = re.search(r"of (\d+) ranges", browser.text())
            return int(found[1]) if found else 0

        # On a busy machine, the viewer drops many, and they must not count as lost by the radio.
        browser.wait("30 ranges of each pair", lambda: received() > 30 * 150)
        # A pair has no rate while all of its latest intervals contain ranges that the viewer has dropped.
        browser.wait("rates of all pairs", lambda: None not in browser.column("pairs", "rate"))
        rates, lost = browser.column("pairs", "rate"), browser.column("pairs", "lost")
    finally:
        stop.set()
        thread.join()
    assert rates == pytest.approx([6.0] * 150, abs=0.7)
    assert sum(lost) / 150 == pytest.approx(10.0, abs=2.0), "a pair has only 30 ranges"
