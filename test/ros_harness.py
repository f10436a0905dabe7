"""Real nodes for tests: a separate DDS domain, nodes as processes, and a client."""

import fcntl
import itertools
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import pytest
import rclpy
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from drives import HALL
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
from rcl_interfaces.msg import SetParametersResult
from rcl_interfaces.srv import SetParameters
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile
from std_msgs.msg import Header
from uwb_mitigation_msgs.msg import RangeCir, RangeCorrected

from uwb_mitigation.types.stamps import NS_PER_S, to_ns
from uwb_mitigation.types.tracks import Ranges

TIMEOUT_S, RESPONSE_TIMEOUT_S = 240.0, 20.0
STATE_AFTER = {
    Transition.TRANSITION_CONFIGURE: "inactive",
    Transition.TRANSITION_ACTIVATE: "active",
    Transition.TRANSITION_DEACTIVATE: "inactive",
    Transition.TRANSITION_CLEANUP: "unconfigured",
    Transition.TRANSITION_UNCONFIGURED_SHUTDOWN: "finalized",
}

PAUSED = ("paused:=true", "start_delay:=0.0", "longest_wait:=3600.0")
"""Parameters of a driver that waits for a subscriber and for `Ros.play`."""

EXPIRY = """<profiles xmlns="http://www.eprosima.com">
<participant profile_name="fast_expiry" is_default_profile="true"><rtps><builtin><discovery_config>
<leaseDuration><sec>{}</sec></leaseDuration><leaseAnnouncement><sec>0</sec><nanosec>500000000</nanosec></leaseAnnouncement>
</discovery_config></builtin></rtps></participant></profiles>"""

# For this process and its children; read when messages are imported and a context is created.
os.environ |= {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST", "ROS_PYTHON_CHECK_FIELDS": "1"}


def diagnostic_values(status: DiagnosticStatus) -> dict[str, str]:
    return {diagnostic_value.key: diagnostic_value.value for diagnostic_value in status.values}


def header_at(time_ns: int, frame: str = "") -> Header:
    return Header(stamp=Time(sec=time_ns // NS_PER_S, nanosec=time_ns % NS_PER_S), frame_id=frame)


def corrected_range(ranges: Ranges, row: int, header: Header, **changes: object) -> RangeCorrected:
    """Return a range of a drive past `HALL` as a message."""
    values = {
        "tag_id": 7,
        "anchor_id": HALL.anchors[ranges.anchor[row]].id,
        "sequence": row,
        "variance": 0.01,
    }
    return RangeCorrected(header=header, **values | {"range": float(ranges.range_m[row])} | changes)


def set_expiry(monkeypatch: pytest.MonkeyPatch, folder: Path, seconds: int) -> None:
    """Let nodes that are started later disappear for others so soon after they are killed, instead of after 20 s."""
    (folder / "expiry.xml").write_text(EXPIRY.format(seconds))
    monkeypatch.setenv("FASTRTPS_DEFAULT_PROFILES_FILE", str(folder / "expiry.xml"))


def stamped_after(messages: list, time_ns: int) -> list:
    """Return the messages with a later stamp: those that were published before may arrive at any time."""
    return [message for message in messages if to_ns(message.header.stamp) > time_ns]


class Process:
    """A running program with its output."""

    def __init__(self, command: list[str], domain: int, log: Path) -> None:
        self.log = log
        environment = os.environ | {"ROS_DOMAIN_ID": str(domain), "PYTHONUNBUFFERED": "1"}
        with log.open("wb") as file:
            self._popen = subprocess.Popen(command, env=environment, stdout=file, stderr=subprocess.STDOUT)
        self.pid = self._popen.pid

    def exit_code(self) -> int | None:
        """Exit code; None while it runs; negative: the signal that ended it."""
        return self._popen.poll()

    @property
    def output(self) -> str:
        return self.log.read_text(errors="replace")

    def send(self, number: signal.Signals) -> None:
        self._popen.send_signal(number)

    def wait(self, timeout_s: float = TIMEOUT_S) -> int:
        try:
            return self._popen.wait(timeout_s)
        except subprocess.TimeoutExpired:
            raise AssertionError(f"still running after {timeout_s} s:\n{self.output}") from None

    def signal(self, number: signal.Signals) -> int:
        self.send(number)
        return self.wait()

    def wait_for_output(self, text: str) -> None:
        deadline = time.monotonic() + TIMEOUT_S
        while text not in self.output:
            ended = self.exit_code() is not None
            assert not ended or text in self.output, f"ended without {text!r}:\n{self.output}"
            assert time.monotonic() < deadline, f"no {text!r} in:\n{self.output}"
            time.sleep(0.02)

    def end(self) -> None:
        """Kill the program if it does not end."""
        try:
            self._popen.wait(10.0)
        except subprocess.TimeoutExpired:
            self.send(signal.SIGKILL)
            self.wait()


class Ros:
    """A DDS domain with processes, and a client node in it."""

    def __init__(self, domain: int, folder: Path) -> None:
        self.domain = domain
        self._folder = folder
        self._processes: list[Process] = []
        self._context = Context()
        rclpy.init(context=self._context, domain_id=domain)
        self.node = Node("test_client", context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)

    def start(self, node: str, *parameters: str, arguments: tuple[str, ...] = ()) -> Process:
        """Start a node of this package like its executable."""
        given = [word for parameter in parameters for word in ("-p", parameter)]
        command = [sys.executable, "-m", "uwb_mitigation.commands.entry", node]
        return self.run([*command, "--ros-args", *given, *arguments])

    def run(self, command: list[str]) -> Process:
        process = Process(command, self.domain, self._folder / f"process_{len(self._processes)}.log")
        self._processes.append(process)
        return process

    def collect(self, kind: type, topic: str, qos: QoSProfile | int = 10_000) -> list:
        """Return a list to which the messages of a topic are appended while the client spins."""
        received: list = []
        self.node.create_subscription(kind, topic, received.append, qos)
        return received

    def spin_until(self, condition: Callable[[], bool], timeout_s: float = TIMEOUT_S) -> None:
        deadline = time.monotonic() + timeout_s
        while not condition():
            assert time.monotonic() < deadline, "timed out:\n" + "\n".join(p.output for p in self._processes)
            self._executor.spin_once(timeout_sec=0.05)

    def spin_for(self, seconds: float) -> None:
        deadline = time.monotonic() + seconds
        while time.monotonic() < deadline:
            self._executor.spin_once(timeout_sec=0.05)

    def wait_for_subscribers(self, topic: str, count: int) -> None:
        self.spin_until(lambda: self.node.count_subscribers(topic) >= count)

    def wait_until_active(self, node: str) -> None:
        """Wait until a node is active and has discovered the subscriptions of this client.

        A client announces its endpoints in order, and the receiver of the answer is created last.
        """
        self.spin_until(lambda: self.state_of(node) == "active")

    def find_each_other(self, publisher: Publisher, question: RangeCir, answers: list) -> None:
        """Call a node until it has answered all calls: then both sides have discovered each other."""
        numbers = itertools.count(1)

        def asked() -> bool:
            question.sequence = next(numbers)
            publisher.publish(question)
            return len(answers) > 0

        self.spin_until(asked)
        self.spin_until(lambda: answers[-1].sequence == question.sequence)
        answers.clear()

    def play(self, driver: str = "driver") -> None:
        """Start the replay of a `PAUSED` driver when the subscriptions of this client are connected."""
        self.spin_until(lambda: all(made.get_publisher_count() for made in self.node.subscriptions))
        self.wait_until_active(driver)
        assert self.set_parameter(driver, "paused", False).successful

    def call(self, kind: type, name: str, request: object, was_done: Callable[[], bool] | None = None) -> Any:
        """Return the response of a service.

        The middleware drops a response while it does not know the client yet: then the call is repeated, or if `was_done`
        is given and becomes true, the result is None.
        """
        client = self.node.create_client(kind, name)
        self.spin_until(client.service_is_ready)
        futures = [client.call_async(request)]
        checked = time.monotonic()

        def is_answered() -> bool:
            nonlocal checked
            if time.monotonic() > checked + RESPONSE_TIMEOUT_S:
                checked = time.monotonic()
                if was_done is not None:
                    return was_done()
                futures.append(client.call_async(request))
            return any(future.done() for future in futures)

        self.spin_until(is_answered)
        self.node.destroy_client(client)
        return next((future.result() for future in futures if future.done()), None)

    def state_of(self, node: str) -> str:
        return self.call(GetState, f"/{node}/get_state", GetState.Request()).current_state.label

    def change_state(self, node: str, transition: int) -> bool:
        """Send a transition once."""
        request = ChangeState.Request()
        request.transition.id = transition
        response = self.call(
            ChangeState,
            f"/{node}/change_state",
            request,
            lambda: self.state_of(node) == STATE_AFTER[transition],
        )
        return response is None or response.success

    def set_parameter(self, node: str, name: str, value: object) -> SetParametersResult:
        request = SetParameters.Request(parameters=[Parameter(name, value=value).to_parameter_msg()])
        return self.call(SetParameters, f"/{node}/set_parameters", request).results[0]

    def diagnosis(self, node: str, matches: Callable[[DiagnosticStatus], bool]) -> DiagnosticStatus:
        """Return the first matching diagnostic status of a node."""
        arrays = self.collect(DiagnosticArray, "/diagnostics", 100)
        found: list[DiagnosticStatus] = []

        def look() -> bool:
            while arrays:
                found.extend(s for s in arrays.pop().status if s.name.startswith(node) and matches(s))
            return bool(found)

        self.spin_until(look)
        return found[0]

    def close(self) -> None:
        """Destroy the client first, then stop the nodes with SIGINT.

        A killed node leaves partial shared memory, and Fast DDS in a process that uses it later can crash
        (eProsima/Fast-DDS issue 6501).
        """
        self.node.destroy_node()
        rclpy.shutdown(context=self._context)
        for process in self._processes:
            process.send(signal.SIGINT)
        for process in self._processes:
            process.end()


@contextmanager
def domain(folder: Path) -> Iterator[Ros]:
    """A domain that no other test on this machine uses."""
    with _reserved() as number:
        ros = Ros(number, folder)
        try:
            yield ros
        finally:
            ros.close()


_counter = itertools.count(os.getpid())


@contextmanager
def _reserved() -> Iterator[int]:
    """Yield the number of a domain that is locked against other workers and test runs."""
    for count in _counter:
        number = 101 + count % 130
        with ExitStack() as stack:
            try:
                place = Path(tempfile.gettempdir(), f"uwb_mitigation_domain_{number}")
                fcntl.flock(stack.enter_context(place.open("a")), fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:  # in use, or of another user
                continue
            yield number
            return
