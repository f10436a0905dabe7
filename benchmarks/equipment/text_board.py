"""Emulated boards that print ranges as text: a DWM1001 with its factory firmware, AT or JSON lines, and a CLI image.

Written from public descriptions and logs of these boards, and not compared with a real one.
"""

from __future__ import annotations

import contextlib
import json
import math
import socket
import threading
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from benchmarks.equipment.emulated_board import MAX_BACKLOG_BYTES, PseudoTerminal
from uwb_mitigation.errors import ParameterError

KINDS = ("pans", "at", "json", "cli")
_BANNER = (
    "\r\n DWM1001 TWR Real Time Location System\r\n\r\n Copyright :  2016-2019 LEAPS and Decawave\r\n"
    " License   :  Please visit https://decawave.com/dwm1001_license\r\n"
    " Compiled  :  Mar 27 2019 03:35:59\r\n\r\n Help      :  ? or help\r\n\r\n"
)
_TLV_ERROR = b"\x40\x01\x01"
"""Answer of the binary interface to an unknown request."""

_ENTER_TIMEOUT_S = 1.0
_ANCHORS = np.array([[0.0, 0.0, 2.0], [8.0, 0.0, 2.0], [8.0, 6.0, 2.0], [0.0, 6.0, 2.0]])
_TAG = np.array([3.0, 2.0, 0.4])
_IDS = (0x022E, 0x9280, 0xDCAE, 0x5431)


class PansShell:
    """The UART of a DWM1001 with PANS R2: binary requests, until two times Enter within a second open the shell.

    The shell echoes what it receives. `lec` and `les` turn their output on and off; an empty line repeats nothing.

    Args:
        banner: what the shell prints when it opens, before its prompt.

    Attributes:
        is_open: whether the shell is open.
        output: the command whose output is on; empty: none.
    """

    def __init__(self, banner: str = _BANNER) -> None:
        self.is_open, self.output, self._banner = False, "", banner
        self._line, self._entered_s = "", -math.inf

    def receive(self, data: bytes, now_s: float) -> bytes:
        """Return the answer."""
        answer = b""
        for octet in data:
            answer += self._shell(chr(octet)) if self.is_open else self._generic(octet, now_s)
        return answer

    def _generic(self, octet: int, now_s: float) -> bytes:
        if octet != 0x0D:
            return _TLV_ERROR
        is_second, self._entered_s = now_s - self._entered_s < _ENTER_TIMEOUT_S, now_s
        self.is_open, self._line = is_second, ""
        return f"{self._banner}dwm> ".encode() if is_second else b""

    def _shell(self, key: str) -> bytes:
        if key != "\r":
            self._line += key
            return key.encode("latin1")
        command, self._line = self._line.strip(), ""
        if command in ("lec", "les"):
            self.output = "" if self.output == command else command
        elif command in ("quit", "reset"):
            self.is_open, self.output, self._entered_s = False, "", -math.inf
            return b"\r\n"
        elif command:
            return f"\r\n{command}: unknown command\r\ndwm> ".encode()
        return b"\r\ndwm> "


class TextBoards:
    """Tags that range with four anchors, each on a pseudo-terminal or to a UDP port, until `close`.

    Args:
        kind: one of `KINDS`.
        boards: number of tags.
        links: prefix of symbolic links to the ports, followed by the board's number.
        rate_hz: outputs per second.
        distance_m: one anchor at this distance instead of four.
        udp: (host, port) to which the lines are sent, instead of a terminal.
        seed: seed of the noise.

    Attributes:
        shells: of the boards, for kind pans.
    """

    failure = None

    def __init__(
        self,
        kind: str = "pans",
        *,
        boards: int = 1,
        links: Path | None = None,
        rate_hz: float = 10.0,
        distance_m: float | None = None,
        udp: tuple[str, int] | None = None,
        seed: int = 1,
    ) -> None:
        if kind not in KINDS:
            raise ParameterError(f"kind = {kind}", valid=", ".join(KINDS))
        self._kind, self._udp, self._interval_s = kind, udp, 1 / rate_hz
        self.true_ranges_m: Sequence[float] = (
            [distance_m] if distance_m is not None else np.linalg.norm(_ANCHORS - _TAG, axis=1).tolist()
        )
        self._random = np.random.default_rng(seed)
        self._lock, self._stop = threading.RLock(), threading.Event()
        self.shells = [PansShell() for _ in range(boards)]
        names = [links.with_name(f"{links.name}{number}") if links else None for number in range(boards)]
        self._terminals = [PseudoTerminal(name) for name in names]
        self._backlogs = [bytearray() for _ in range(boards)]
        self._sender = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        for number in range(boards):
            self.plug(number)
        self._thread = threading.Thread(target=self._run, name="emulated text boards", daemon=True)
        self._thread.start()

    @property
    def ports(self) -> tuple[str, ...]:
        """Ports of the boards; empty if unplugged."""
        with self._lock:
            return tuple(terminal.port for terminal in self._terminals)

    def unplug(self, number: int) -> None:
        """Unplug a board."""
        with self._lock:
            self._terminals[number].unplug()

    def plug(self, number: int) -> None:
        """Plug a board in; it starts again."""
        with self._lock:
            if self._udp is None and self._terminals[number].plug():
                self._backlogs[number].clear()
                self.reset(number)

    def reset(self, number: int) -> None:
        """Let a board start again while its port stays, as after a loss of its supply."""
        with self._lock:
            self.shells[number] = PansShell()

    def inject(self, number: int, data: bytes) -> None:
        """Send other bytes between the lines."""
        with self._lock:
            self._backlogs[number] += data

    def close(self) -> None:
        """Unplug all boards and stop the thread; may be called twice."""
        self._stop.set()
        self._thread.join()
        self._sender.close()
        for terminal in self._terminals:
            terminal.unplug()

    def __enter__(self) -> TextBoards:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _run(self) -> None:
        sequence, due_s = 0, time.monotonic()
        while not self._stop.wait(0.005):
            with self._lock:
                now_s = time.monotonic()
                is_due = now_s >= due_s
                sequence += is_due
                due_s = max(due_s + self._interval_s * is_due, now_s - 1.0)
                for number, terminal in enumerate(self._terminals):
                    received, backlog = terminal.read(), self._backlogs[number]
                    if self._kind == "pans":
                        backlog += self.shells[number].receive(received, now_s)
                    if is_due and len(backlog) < MAX_BACKLOG_BYTES:
                        backlog += self._text(number, sequence).encode()
                    if self._udp is None:
                        terminal.write(backlog)
                    elif backlog:
                        with contextlib.suppress(OSError):
                            self._sender.sendto(bytes(backlog), self._udp)
                        backlog.clear()

    def _text(self, number: int, sequence: int) -> str:
        """Return the output of an exchange with all anchors."""
        ranges_m = [max(0.0, true + float(self._random.normal(0.0, 0.02))) for true in self.true_ranges_m]
        known = list(zip(_IDS, _ANCHORS, ranges_m, strict=False))
        if self._kind == "json":
            entries = [{"anchor": key, "range_m": round(range_m, 3)} for key, _, range_m in known]
            return json.dumps({"tag": number + 1, "ranges": entries}) + "\n"
        if self._kind == "at":
            slots = [*(round(100 * range_m) for range_m in ranges_m), *[0] * (8 - len(ranges_m))]
            levels = ",".join("-77.60" if slot else "0.00" for slot in slots)
            texts = f"range:({','.join(map(str, slots))}),rssi:({levels})"
            return f"AT+RANGE=tid:{number + 1},mask:0F,seq:{sequence & 255},{texts}\r\n"
        if self._kind == "cli":
            rows = [
                f' [mac_address=0x{key:04x}, status="SUCCESS", distance[cm]={round(100 * range_m)}]'
                for key, _, range_m in known
            ]
            head = f"session_handle=1, sequence_number={sequence}, block_index={sequence}, n_measurements={len(rows)}"
            return f"SESSION_INFO_NTF: {{{head}\r\n" + ";\r\n".join(rows) + "}\r\n"
        output = self.shells[number].output
        position = ",".join(f"{value:.2f}" for value in _TAG)
        if output == "lec":
            shown = [
                f"AN{slot},{key:04X},{','.join(f'{value:.2f}' for value in place)},{range_m:.2f}"
                for slot, (key, place, range_m) in enumerate(known)
            ]
            return f"DIST,{len(known)},{','.join(shown)},POS,{position},72\r\n"
        if output == "les":
            shown = [
                f"{key:04X}[{','.join(f'{value:.2f}' for value in place)}]={range_m:.2f}"
                for key, place, range_m in known
            ]
            return f"{' '.join(shown)} le_us=3082 est[{position},72]\r\n"
        return ""
