"""Emulated boards with Qorvo's UCI firmware, written from public facts and never compared with a real board.

`UciBoardModel` has no I/O: it takes commands and the time, and returns packets. `EmulatedUciBoards` puts several of
them on one air and on pseudo-terminals. The CIRs are a first path, some reflections and noise.
"""

from __future__ import annotations

import contextlib
import os
import select
import struct
import threading
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.equipment.emulated_board import PseudoTerminal
from uwb_mitigation.errors import ParameterError
from uwb_mitigation.radios.fira import codes
from uwb_mitigation.radios.fira.codes import PacketType, SessionState
from uwb_mitigation.radios.fira.packets import encode_packets

TAPS, LEAD = "rx_diag_config.cir_n_taps", "rx_diag_config.cir_fp_tap_offset"
FIRST_PATH = 362
"""Tap of the first path in the accumulator of an STS segment."""

_FRAGMENT_BYTES = 255
_REJECTED, _INVALID_PARAMETER, _NOT_CONFIGURED, _NO_SESSION = 0x01, 0x04, 0x15, 0x11
_STATUS_FIELD, _CFO_FIELD, _EMITTER_FIELD, _METRICS_FIELD, _CIR_FIELD = 3, 4, 5, 6, 7
_NEEDED = frozenset((0x00, 0x04, 0x06, 0x07, 0x08, 0x09, 0x11, 0x1B, 0xE8, 0xE9))
_BOOT_S = 0.15
_MAX_WAIT_S = 0.005


@dataclass(frozen=True, slots=True)
class UciFaults:
    """Faults of an emulated board. Shares are probabilities.

    Attributes:
        lose: share of notifications that are not sent.
        swap: share of exchanges whose diagnostics are sent before the range.
        late: share of exchanges whose diagnostics are sent after the next range.
        garbage: share of notifications with random bytes before them.
        errors: share of commands that get an error status.
        offset_m: error of all ranges, such as that of a wrong antenna delay.
        empty_cir: the diagnostics contain no CIR.
        clock_ppm: carrier frequency offset of the peer.
        swapped_ids: the board reports its own address as that of the peer.
    """

    lose: float = 0.0
    swap: float = 0.0
    late: float = 0.0
    garbage: float = 0.0
    errors: float = 0.0
    offset_m: float = 0.0
    empty_cir: bool = False
    clock_ppm: float = 3.0
    swapped_ids: bool = False

    def __post_init__(self) -> None:
        for name in ("lose", "swap", "late", "garbage", "errors"):
            if not 0 <= getattr(self, name) <= 1:
                raise ParameterError(f"{name} = {getattr(self, name)}", valid="0 to 1")


def taps_of(sequence: int, count: int, lead: int) -> NDArray[np.int32]:
    """Return the taps of an exchange, int32 (count, 2); each exchange has other noise."""
    random = np.random.default_rng(sequence)
    taps = random.normal(0.0, 60.0, (count, 2))
    for delay, amplitude in ((0, 3500.0), (1, 6000.0), (2, 4000.0), (6, 1500.0), (11, 900.0)):
        if lead + delay < count:
            taps[lead + delay, 0] += amplitude
    return np.rint(taps).astype(np.int32)


@dataclass(slots=True)
class _Session:
    """A ranging session of a board."""

    number: int
    config: dict[int, bytes]
    active: bool = False
    sequence: int = 0
    due_s: float = 0.0
    partner: bool = False

    def value(self, tag: int) -> int:
        return int.from_bytes(self.config.get(tag, b""), "little")


class UciBoardModel:
    """One board. Every method returns the bytes that it sends.

    Args:
        max_taps: largest window that it accepts.
        tap_bytes: size of a complex tap.
        count_bytes: size of the count in SET_CALIBRATION.
        rejects: parameters of sessions that it does not know.
        faults: see `UciFaults`.
        seed: seed of the faults.
    """

    def __init__(
        self,
        *,
        max_taps: int = 255,
        tap_bytes: int = 6,
        count_bytes: int = 2,
        rejects: frozenset[int] = frozenset(),
        faults: UciFaults = UciFaults(),
        seed: int = 1,
    ) -> None:
        self.faults = faults
        self.exchanges = 0
        self._max_taps, self._tap_bytes, self._count_bytes = max_taps, tap_bytes, count_bytes
        self._rejects = rejects
        self._random = np.random.default_rng(seed)
        self._buffer = bytearray()
        self._fragments = bytearray()
        self._late = b""
        self.boot()

    def boot(self) -> bytes:
        """Power the board on."""
        self._calibration = {TAPS: 16, LEAD: 8}
        self._buffer.clear()
        self._fragments.clear()
        self.sessions: dict[int, _Session] = {}
        self._handles = 0
        return self._notify(codes.BOOT, b"\0") + self._notify(codes.DEVICE_STATUS, b"\1")

    def receive(self, data: bytes, now_s: float) -> bytes:
        """Return the answers to the commands in `data`."""
        self._buffer += data
        sent = b""
        while len(self._buffer) >= 4 and len(self._buffer) >= 4 + self._buffer[3]:
            first, opcode, _, length = self._buffer[:4]
            self._fragments += self._buffer[4 : 4 + length]
            del self._buffer[: 4 + length]
            if first >> 5 != PacketType.COMMAND:
                self._fragments.clear()
            elif not first & 0x10:
                payload = bytes(self._fragments)
                self._fragments.clear()
                sent += self._command((first & 0xF, opcode), payload, now_s)
        return sent

    def _command(self, name: tuple[int, int], payload: bytes, now_s: float) -> bytes:
        if self._random.random() < self.faults.errors:
            return self._respond(name, bytes([_REJECTED]))
        handle = struct.unpack_from("<I", payload)[0] if len(payload) >= 4 else 0
        session = self.sessions.get(handle)
        if name == codes.RESET:
            self.sessions.clear()
            return self._notify(codes.DEVICE_STATUS, b"\1") + self._respond(name, b"\0")
        if name == codes.DEVICE_INFO:
            return self._respond(name, b"\0" + b"emulated")
        if name == codes.SESSION_INIT:
            self._handles += 1
            self.sessions[self._handles] = _Session(handle, {})
            created = struct.pack("<I", self._handles)
            return self._respond(name, b"\0" + created) + self._state(self._handles, SessionState.INIT)
        if name == codes.SET_CALIBRATION:
            return self._respond(name, bytes([0 if self._set_calibration(payload) else _INVALID_PARAMETER]))
        if name == codes.GET_CALIBRATION:
            return self._respond(name, self._get_calibration(payload))
        if session is None:
            return self._respond(name, bytes([_NO_SESSION]))
        if name == codes.SET_APP_CONFIG:
            offset, config = 5, {}
            while offset + 1 < len(payload):
                config[payload[offset]] = payload[offset + 2 : offset + 2 + payload[offset + 1]]
                offset += 2 + payload[offset + 1]
            if rejected := bytes(sorted(self._rejects & config.keys())):
                statuses = b"".join(bytes([tag, _INVALID_PARAMETER]) for tag in rejected)
                return self._respond(name, bytes([_INVALID_PARAMETER, len(rejected)]) + statuses)
            session.config |= config
            return self._respond(name, b"\0\0") + self._state(handle, SessionState.IDLE)
        if name == codes.GET_SESSION_STATE:
            return self._respond(
                name, bytes([0, SessionState.ACTIVE if session.active else SessionState.IDLE])
            )
        if name == codes.RANGE_START:
            if not set(session.config) >= _NEEDED:
                return self._respond(name, bytes([_NOT_CONFIGURED]))
            session.active, session.due_s = True, now_s + session.value(0x09) / 1e3
            return self._respond(name, b"\0") + self._state(handle, SessionState.ACTIVE)
        if name == codes.RANGE_STOP:
            session.active = False
            return self._respond(name, b"\0") + self._state(handle, SessionState.IDLE)
        if name == codes.SESSION_DEINIT:
            del self.sessions[handle]
            return self._respond(name, b"\0") + self._state(handle, SessionState.DEINIT)
        return self._respond(name, bytes([_REJECTED]))

    def exchange(self, handle: int, sequence: int, distance_m: float) -> bytes:
        """Return the notifications of an exchange; NaN: the peer did not answer."""
        self.exchanges += 1
        failed = distance_m != distance_m
        notifications = [
            b""
            if self._random.random() < self.faults.lose
            else self.range_packet(handle, sequence, distance_m)
        ]
        if not failed:
            lost = self._random.random() < self.faults.lose
            notifications.append(b"" if lost else self.diagnostics_packet(handle, sequence))
        if self._random.random() < self.faults.swap:
            notifications.reverse()
        notifications = [
            self._random.bytes(5) + packet
            if packet and self._random.random() < self.faults.garbage
            else packet
            for packet in notifications
        ]
        late, self._late = self._late, b""
        if not failed and self._random.random() < self.faults.late:
            self._late = notifications.pop()
        return notifications[0] + late + b"".join(notifications[1:])

    def range_packet(self, handle: int, sequence: int, distance_m: float) -> bytes:
        """Return a range notification."""
        session = self.sessions[handle]
        status = 0x21 if distance_m != distance_m else 0x1B if distance_m + self.faults.offset_m < 0 else 0
        distance_cm = 0xFFFF if status else round(100 * (distance_m + self.faults.offset_m))
        peer = session.value(0x06 if self.faults.swapped_ids else 0x07)
        header = struct.pack("<IIBIBBBIIB", sequence, handle, 0, session.value(0x09), 1, 0, 0, 0, 0, 1)
        record = struct.pack("<HBBH12xBB11x", peer, status, 0xFF, distance_cm, 0, 0)
        return self._notify(codes.RANGE_START, header + record)

    def diagnostics_packet(self, handle: int, sequence: int) -> bytes:
        """Return a diagnostics notification: of the frame that an initiator receives, or of those of a responder."""
        session = self.sessions[handle]
        mask, initiator = session.value(0xE9), session.value(0x11) == 1
        received = (1,) if initiator else (0, 2)
        reports = []
        for frame in (0, 1, 2):
            fields = [_field(_STATUS_FIELD, b"\1\0")]
            if frame in received:
                if mask & 0x08:
                    fields.append(
                        _field(_CFO_FIELD, struct.pack("<i", round(self.faults.clock_ppm * 1e-6 * (1 << 26))))
                    )
                if mask & 0x10:
                    fields.append(_field(_EMITTER_FIELD, session.config[0x07]))
                if mask & 0x20:
                    fields.append(_field(_METRICS_FIELD, self._metrics(sequence)))
                if mask & 0x40 and not self.faults.empty_cir:
                    fields.append(_field(_CIR_FIELD, self._cir(sequence)))
            reports.append(bytes([frame, 0 if frame in received else 1, 0, len(fields)]) + b"".join(fields))
        payload = struct.pack("<IIB", handle, sequence, len(reports)) + b"".join(reports)
        return self._notify(codes.RANGE_DIAGNOSTICS, payload)

    def _metrics(self, sequence: int) -> bytes:
        rx, first_path = round(256 * 80.5), round(256 * 84.0)
        position = 64 * FIRST_PATH + sequence % 64
        return struct.pack(
            "<BhHHHHHHH", 9, -80, rx, FIRST_PATH, first_path, position, FIRST_PATH + 1, rx, position + 64
        )

    def _cir(self, sequence: int) -> bytes:
        count, lead, width = self._calibration[TAPS], self._calibration[LEAD], self._tap_bytes // 2
        values = taps_of(sequence, count, lead).reshape(-1)
        octets = values.astype("<i4").view(np.uint8).reshape(-1, 4)[:, :width]
        return struct.pack("<BbBB", 9, -lead, count, self._tap_bytes) + octets.tobytes()

    def _set_calibration(self, payload: bytes) -> bool:
        offset, values = self._count_bytes, dict(self._calibration)
        with contextlib.suppress(IndexError):
            for _ in range(int.from_bytes(payload[:offset], "little")):
                key = payload[offset + 1 : offset + 1 + payload[offset]].decode("ascii", "replace")
                offset += 1 + payload[offset]
                if key not in values:
                    return False
                values[key] = int.from_bytes(payload[offset + 1 : offset + 1 + payload[offset]], "little")
                offset += 1 + payload[offset]
            values[TAPS] = min(values[TAPS], self._max_taps)
            self._calibration = values
            return True
        return False

    def _get_calibration(self, payload: bytes) -> bytes:
        offset, answer = 2, b""
        for _ in range(int.from_bytes(payload[:2], "little")):
            key = payload[offset + 1 : offset + 1 + payload[offset]]
            offset += 1 + len(key)
            value = self._calibration.get(key.decode("ascii", "replace"))
            entry = b"\0\2" + value.to_bytes(2, "little") if value is not None else b"\1\0"
            answer += bytes([len(key)]) + key + entry
        return b"\0" + payload[:2] + answer

    def _state(self, handle: int, state: int) -> bytes:
        return self._notify(codes.SESSION_STATUS, struct.pack("<IBB", handle, state, 0))

    def _respond(self, name: tuple[int, int], payload: bytes) -> bytes:
        return encode_packets(*name, payload, PacketType.RESPONSE, _FRAGMENT_BYTES)

    def _notify(self, name: tuple[int, int], payload: bytes) -> bytes:
        return encode_packets(*name, payload, PacketType.NOTIFICATION, _FRAGMENT_BYTES)


def _field(kind: int, data: bytes) -> bytes:
    return struct.pack("<BH", kind, len(data)) + data


class EmulatedUciBoards:
    """Boards on one air, each on a pseudo-terminal, until `close`. Methods may be called from any thread.

    A controller and a controlee with the same session number and addresses exchange ranges.

    Args:
        boards: number of boards.
        distance_m: distance between the boards.
        links: prefix of symbolic links to the ports, followed by the board's number.
        seed: seed of the faults and of the ranges.
        board: arguments of `UciBoardModel`.
    """

    def __init__(
        self,
        *,
        boards: int = 2,
        distance_m: float = 3.0,
        links: Path | None = None,
        seed: int = 1,
        **board: Any,
    ) -> None:
        if not 1 <= boards <= 33:
            raise ParameterError(f"boards = {boards}", valid="1 to 33")
        self._distance_m = distance_m
        self._random = np.random.default_rng(seed)
        self._lock = threading.RLock()
        self._stop = threading.Event()
        self.failure = None
        self._models = [UciBoardModel(seed=seed + number, **board) for number in range(boards)]
        names = [
            links.with_name(f"{links.name}{number}") if links is not None else None
            for number in range(boards)
        ]
        self._terminals = [PseudoTerminal(name) for name in names]
        self._backlogs = [bytearray() for _ in range(boards)]
        self._boots_s = [0.0] * boards
        for number in range(boards):
            self.plug(number)
        self._thread = threading.Thread(target=self._run, name="emulated UCI boards", daemon=True)
        self._thread.start()

    @property
    def ports(self) -> tuple[str, ...]:
        """Ports of the boards; empty if unplugged."""
        with self._lock:
            return tuple(terminal.port for terminal in self._terminals)

    @property
    def exchanges(self) -> int:
        """Number of exchanges of the first board."""
        return self._models[0].exchanges

    def set_faults(self, faults: UciFaults) -> None:
        """Use other faults from now on."""
        with self._lock:
            for model in self._models:
                model.faults = replace(faults)

    def unplug(self, number: int) -> None:
        """Unplug a board."""
        with self._lock:
            self._terminals[number].unplug()
            self._models[number].sessions.clear()

    def plug(self, number: int) -> None:
        """Plug a board in; it starts within 0.15 s and ignores commands meanwhile."""
        with self._lock:
            if self._terminals[number].plug():
                self._backlogs[number][:] = self._models[number].boot()
                self._boots_s[number] = time.monotonic() + _BOOT_S

    def close(self) -> None:
        """Unplug all boards and stop the thread; may be called twice."""
        self._stop.set()
        self._thread.join()
        for terminal in self._terminals:
            terminal.unplug()

    def __enter__(self) -> EmulatedUciBoards:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _run(self) -> None:
        while not self._stop.is_set():
            with self._lock:
                fds = [terminal.fd for terminal in self._terminals]
            with contextlib.suppress(OSError, ValueError):
                select.select([fd for fd in fds if fd is not None], [], [], _MAX_WAIT_S)
            with self._lock:
                now_s = time.monotonic()
                for number in range(len(self._models)):
                    self._read(number, now_s)
                self._range(now_s)
                for number, terminal in enumerate(self._terminals):
                    if terminal.fd is not None and self._backlogs[number]:
                        with contextlib.suppress(OSError):
                            del self._backlogs[number][: os.write(terminal.fd, self._backlogs[number])]

    def _read(self, number: int, now_s: float) -> None:
        fd = self._terminals[number].fd
        with contextlib.suppress(OSError):
            data = os.read(fd, 1 << 14) if fd is not None else b""
            if data and now_s >= self._boots_s[number]:
                self._backlogs[number] += self._models[number].receive(data, now_s)

    def _range(self, now_s: float) -> None:
        """Perform the exchanges that are due."""
        for number, model in enumerate(self._models):
            for handle, session in model.sessions.items():
                if not session.active or session.value(0x00) != 1 or now_s < session.due_s:
                    continue
                session.due_s = max(session.due_s + session.value(0x09) / 1e3, now_s - 1.0)
                session.sequence += 1
                partner = self._partner(number, session)
                distance_m = float("nan")
                if partner is not None:
                    distance_m = self._distance_m + float(self._random.normal(0.0, 0.02))
                    peer, peer_handle = partner
                    self._send(peer, peer_handle, session.sequence, distance_m)
                self._send(number, handle, session.sequence, distance_m)

    def _send(self, number: int, handle: int, sequence: int, distance_m: float) -> None:
        sent = self._models[number].exchange(handle, sequence, distance_m)
        if len(self._backlogs[number]) < 1 << 16:
            self._backlogs[number] += sent

    def _partner(self, number: int, session: _Session) -> tuple[int, int] | None:
        for peer, model in enumerate(self._models):
            for handle, theirs in model.sessions.items():
                if (
                    peer != number
                    and theirs.active
                    and theirs.number == session.number
                    and theirs.value(0x00) == 0
                    and theirs.config[0x06] == session.config[0x07]
                    and theirs.config[0x07] == session.config[0x06]
                    and all(theirs.config[tag] == session.config[tag] for tag in (0x04, 0x14, 0x12, 0x35))
                ):
                    return peer, handle
        return None
