"""Run the firmware in an emulated Cortex-M4 as a board on a serial link.

`boards/qemu_mps2_link` runs the library and the board side of the protocol. Its first UART is a pseudo-terminal for
the driver; the second one receives frames of the radio like those of an EVB1000.
"""

from __future__ import annotations

import math
import os
import re
import socket
import subprocess
import tempfile
import time
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

from uwb_mitigation.errors import UwbMitigationError
from uwb_mitigation.mitigation.early_path import NOISE_TAPS, SEARCH_TAPS
from uwb_mitigation.mitigation.embedded.export import export_bundle
from uwb_mitigation.mitigation.embedded.toolchain import Target, compile_image, require_tools
from uwb_mitigation.mitigation.model.bundle import Bundle
from uwb_mitigation.mitigation.preprocessing import WINDOW_LEAD
from uwb_mitigation.radios.wire import messages
from uwb_mitigation.radios.wire.framing import FrameEncoder
from uwb_mitigation.types.measurement import Encoding, RangeMeasurement

_START_TIMEOUT_S = 60.0
_PORT = re.compile(rb"char device redirected to (\S+)")


def cut_to_window(measurement: RangeMeasurement, samples: int, lead: int = WINDOW_LEAD) -> RangeMeasurement:
    """Cut a CIR to the `samples` that the network reads, and `lead` taps before the first path; if some are missing, keep all."""
    cir = measurement.cir
    if not math.isfinite(cir.first_path_index):
        return measurement
    start = math.floor(cir.first_path_index) - lead
    samples += lead - WINDOW_LEAD
    values = 2 if cir.encoding is Encoding.COMPLEX_INT16 else 1
    first = values * (start - cir.start_index)
    window = cir.samples[max(first, 0) : first + values * samples]
    if first < 0 or len(window) < values * samples:
        return measurement
    return replace(measurement, cir=replace(cir, samples=window, start_index=start))


class EmulatedFirmware:
    """Builds the firmware with `bundle`'s model and starts it; `close` or leaving the context stops it.

    Raises:
        MissingDependencyError: compiler or emulator are missing; the message contains the command to install them.
        ModelError: the firmware cannot run the model.
        UwbMitigationError: it does not build, or does not start.

    Attributes:
        port: path of the pseudo-terminal for the driver.
    """

    def __init__(self, bundle: Bundle) -> None:
        require_tools()
        self._folder = tempfile.TemporaryDirectory(prefix="uwb_emulated_firmware_")
        self._encoder = FrameEncoder()
        self._samples = bundle.card.preprocessing.samples
        self._lead = SEARCH_TAPS + NOISE_TAPS if bundle.card.early_path else WINDOW_LEAD
        self._process: subprocess.Popen[bytes] | None = None
        self._radio: socket.socket | None = None
        self.port = ""
        try:
            folder = Path(self._folder.name)
            export_bundle(bundle, folder)
            self._start(compile_image(folder, folder, Target.QEMU_MPS2_LINK).elf, folder / "radio")
        except BaseException:
            self.close()
            raise

    def measure(self, measurement: RangeMeasurement) -> None:
        """Send a measurement of the radio to the board; wait while the board is busy.

        Like an EVB1000, the radio sends only the samples that the model reads, because the emulated UART
        transfers single bytes.

        Raises:
            UwbMitigationError: the emulator has exited.
        """
        assert self._radio is not None
        kind, payload = messages.encode(cut_to_window(measurement, self._samples, self._lead))
        try:
            self._radio.sendall(self._encoder.encode(kind, payload))
        except OSError as error:
            raise UwbMitigationError(f"the emulated board has exited: {error.strerror or error}") from error

    def close(self) -> None:
        """Stop the emulator; may be called twice."""
        if self._radio is not None:
            self._radio.close()
        if self._process is not None:
            self._process.terminate()
            try:
                self._process.wait(timeout=5)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()
            if self._process.stdout is not None:
                self._process.stdout.close()
        self._folder.cleanup()

    def __enter__(self) -> EmulatedFirmware:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _start(self, elf: Path, radio: Path) -> None:
        self._process = subprocess.Popen(
            [
                *("qemu-system-arm", "-M", "mps2-an386", "-display", "none", "-monitor", "none"),
                *("-chardev", "pty,id=host", "-serial", "chardev:host"),
                *("-chardev", f"socket,id=radio,path={radio},server=on,wait=off", "-serial", "chardev:radio"),
                *("-kernel", str(elf)),
            ],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            # Only the program that started the emulator handles Ctrl-C.
            start_new_session=True,
        )
        assert self._process.stdout is not None
        output = b""
        deadline = time.monotonic() + _START_TIMEOUT_S
        os.set_blocking(self._process.stdout.fileno(), False)
        while not (match := _PORT.search(output)):
            output += self._process.stdout.read() or b""
            if self._process.poll() is not None or time.monotonic() > deadline:
                raise UwbMitigationError(
                    f"the emulator did not start: {output.decode(errors='replace').strip()[-300:]}"
                )
            time.sleep(0.02)
        self.port = match.group(1).decode()
        self._radio = socket.socket(socket.AF_UNIX)
        while True:
            with suppress(OSError):
                self._radio.connect(str(radio))
                return
            if time.monotonic() > deadline:
                raise UwbMitigationError("the emulator does not accept the connection of the radio")
            time.sleep(0.02)
