"""A board with a radio of its own as an ARM image in QEMU, its SPI over a UART to a modelled chip."""

from __future__ import annotations

import ctypes
import socket
import struct
import subprocess
import time
from pathlib import Path

import pytest

from benchmarks.dw1000_model.boards import ModelledAir
from benchmarks.dw1000_model.library import Request
from benchmarks.dw1000_model.links import Link
from uwb_mitigation.firmware_export import toolchain
from uwb_mitigation.firmware_export.compiling import c_compiler, firmware_folder, run
from uwb_mitigation.firmware_export.host import library_objects
from uwb_mitigation.firmware_export.toolchain import Target
from uwb_mitigation.link import messages
from uwb_mitigation.link.framing import FrameDecoder
from uwb_mitigation.link.layout import Role
from uwb_mitigation.link.radio import RadioSettings
from uwb_mitigation.measurement import RangeMeasurement

pytestmark = pytest.mark.skipif(bool(toolchain.missing_tools()), reason=toolchain.APT)

SPI_SLOW, SPI_FAST, DELAY, WAIT, RESET = range(5)
KINDS = {SPI_SLOW: 0, SPI_FAST: 0, DELAY: 1, WAIT: 2, RESET: 3}
SECONDS = 0.1
PATIENCE_S = 240


class Bridge:
    """Hands what an image asks of its chip to the model, and back."""

    def __init__(self, connection: socket.socket) -> None:
        self.socket = connection
        self.socket.settimeout(PATIENCE_S)
        self.received: ctypes.Array[ctypes.c_char] | None = None
        self.sent = b""
        self.answering = False

    def next(self, request: Request) -> bool:
        if self.answering:
            read = b"" if self.received is None else self.received.raw
            answer = struct.pack("<BQ", request.line, int(request.now_s * 1e6)) + read
            self.socket.sendall(answer)
        self.answering = True
        self.received = None
        kind, count = struct.unpack("<BH", self.take(3))
        payload = self.take(count)
        request.kind = KINDS[kind]
        if kind in (SPI_SLOW, SPI_FAST):
            self.sent, self.received = payload, ctypes.create_string_buffer(count)
            request.out = ctypes.cast(ctypes.c_char_p(self.sent), ctypes.c_void_p)
            request.in_ = ctypes.cast(self.received, ctypes.c_void_p)
            request.n, request.hz = count, 8_000_000 if kind == SPI_FAST else 2_000_000
        elif kind == WAIT:
            (until_us,) = struct.unpack("<Q", payload)
            request.seconds = max(until_us * 1e-6 - request.now_s, 1e-6)
        elif kind == DELAY:
            (us,) = struct.unpack("<Q", payload)
            request.seconds = us * 1e-6
        return True

    def take(self, count: int) -> bytes:
        data = b""
        while len(data) < count:
            piece = self.socket.recv(count - len(data))
            assert piece, "the emulator has ended"
            data += piece
        return data


def range_with(connection: socket.socket) -> None:
    """Give what is behind the connection a chip, and an anchor to range with, for a while of virtual time."""
    bridge = Bridge(connection)
    with ModelledAir(5) as air:
        tag = air.add_remote(bridge.next, ppm=9)
        air.link(tag, air.add(RadioSettings(role=Role.ANCHOR), ppm=-6), Link(4.5))
        air.run(SECONDS)
        connection.close()


def native(folder: Path) -> bytes:
    """What the native build of the board's program sends to its host."""
    program = folder / "native"
    main = firmware_folder() / "boards" / "qemu_mps2_radio" / "main.c"
    include = f"-I{firmware_folder() / 'src'}"
    options = ("-std=gnu11", "-O2", include, str(main), *library_objects())
    run([*c_compiler(), *options, "-lm", "-o", str(program)])
    ours, its = socket.socketpair()
    output = folder / "native.bin"
    with output.open("wb") as file, its:
        process = subprocess.Popen([program], stdin=its, stdout=file)
    try:
        range_with(ours)
        process.wait(PATIENCE_S)
    finally:
        process.kill()
        process.wait()
    return output.read_bytes()


def emulated(folder: Path) -> bytes:
    """What the image sends in the emulator."""
    image = toolchain.build_image(folder, folder, Target.QEMU_MPS2_RADIO)
    output, path = folder / "host.bin", folder / "radio"
    emulator = subprocess.Popen(
        [
            *("qemu-system-arm", "-M", "mps2-an386", "-display", "none", "-monitor", "none"),
            *("-serial", f"file:{output}"),
            # It waits for who connects: what the image asks before would be lost.
            *("-chardev", f"socket,id=radio,path={path},server=on,wait=on", "-serial", "chardev:radio"),
            *("-kernel", str(image.elf)),
        ],
        stdin=subprocess.DEVNULL,
    )
    try:
        connection = socket.socket(socket.AF_UNIX)
        until = time.monotonic() + PATIENCE_S
        while connection.connect_ex(str(path)):
            assert time.monotonic() < until, "the emulator did not start"
            time.sleep(0.05)
        range_with(connection)
    finally:
        emulator.terminate()
        emulator.wait()
    return output.read_bytes()


def test_the_image_ranges_and_sends_byte_for_byte_what_the_native_build_sends(tmp_path: Path):
    ours, its = native(tmp_path), emulated(tmp_path)
    # The last frame may have been cut off on either side.
    both = min(len(ours), len(its))
    decoded = [messages.decode(frame.type, frame.payload) for frame in FrameDecoder().feed(ours[:both])]
    ranges = [message for message in decoded if isinstance(message, RangeMeasurement)]
    assert len(ranges) > 10
    assert abs(ranges[-1].range_m - 4.5) < 0.02
    assert its[:both] == ours[:both]
    assert max(len(ours), len(its)) - both < 1000
