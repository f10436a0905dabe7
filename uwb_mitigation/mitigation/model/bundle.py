"""A model bundle: one ONNX file whose metadata contains everything that running it needs.

The metadata property `uwb_mitigation` is canonical JSON. Its `model_id` is the checksum of the file: the CRC-32 with
the eight hexadecimal digits of the id set to zero. It identifies the model in every corrected range. It detects damage
before ONNX Runtime reads the file; it does not protect against forgery.
"""

from __future__ import annotations

import json
import re
import zlib
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from functools import lru_cache
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.errors import ModelError, UwbMitigationError
from uwb_mitigation.files import read_bounded, write_atomically
from uwb_mitigation.mitigation.model.architecture import Architecture, Mlp, Remnet
from uwb_mitigation.mitigation.model.linear_bias import LinearBiasModel
from uwb_mitigation.mitigation.model.ood import Band, OodBands, check_float32
from uwb_mitigation.mitigation.preprocessing import Preprocessing, Scaling
from uwb_mitigation.types.measurement import RadioType, Segment

if TYPE_CHECKING:
    import onnxruntime

FORMAT = 1
METADATA_KEY = "uwb_mitigation"
MAX_BYTES = 64 << 20

_MARKER = re.compile(rb'"model_id":"([0-9a-f]{8})"')
_BLANK = b"00000000"
_REMEDY = "a bundle written by `uwb-mitigation train`, `quantise` or `calibrate`"


@dataclass(frozen=True, slots=True)
class ModelCard:
    """Description of the network in a bundle.

    Attributes:
        name: human-readable name.
        architecture: shape of the network.
        preprocessing: preprocessing of the input; its window length is K of the architecture.
        linear_bias: linear model whose residuals the network predicts.
        quantised: True: int8; False: float32.
        variance_m2: variance of a range whose predicted error is 0, m^2.
        variance_uncorrected_m2: variance of a range that is passed through, m^2.
        correction_limits_m: predicted errors outside of these limits mean that the input is out of distribution.
        training: data, split, seed, recipe and metrics; human-readable, JSON values only.
        scale: standard deviation of a corrected range by the size of its predicted error, pairs (m, m) that begin at
            size 0: linear between them, and constant beyond the last one.
        interval95_sigmas: number of standard deviations that cover 95 % of the errors on unseen configurations.
        ood_bands: bands outside of which a measurement is out of distribution; None = unknown.
        radios, segments: sources of the CIRs that the network was trained for.
        channels: UWB channels of the training data; empty = unknown.
        early_path: a missed direct path (`mitigation.early_path`) replaces the prediction of the network.
        needs_cir: False = the network predicts 0, so that the linear bias model also corrects ranges without a CIR.
    """

    name: str
    architecture: Architecture
    preprocessing: Preprocessing
    linear_bias: LinearBiasModel
    quantised: bool
    variance_m2: float
    variance_uncorrected_m2: float
    correction_limits_m: tuple[float, float]
    training: Mapping[str, Any] = field(default_factory=dict)
    scale: tuple[tuple[float, float], ...] = ((0.0, 0.25),)
    interval95_sigmas: float = 1.96
    ood_bands: OodBands | None = None
    needs_cir: bool = True
    early_path: bool = False
    radios: tuple[RadioType, ...] = (RadioType.DW1000,)
    segments: tuple[Segment, ...] = (Segment.IPATOV,)
    channels: tuple[int, ...] = ()

    @property
    def scale_lines(self) -> NDArray[np.float32]:
        """Begin (m), intercept (m) and slope of each line of `scale`, float32 (n, 3)."""
        sizes, deviations = np.array(self.scale).T
        slopes = np.append(np.diff(deviations) / np.diff(sizes), 0.0)
        return np.stack([sizes, deviations - slopes * sizes, slopes], axis=1).astype(np.float32)

    @property
    def source(self) -> str:
        """Radios and segments of the training data, human-readable."""
        return " ".join("/".join(kind.name for kind in kinds) for kinds in (self.radios, self.segments))

    @property
    def label(self) -> str:
        """Name, and whether the model is experimental according to the description of its training data."""
        return self.name + " (experimental)" * ("experimental" in str(self.training.get("data")))

    @property
    def origin(self) -> str:
        """Boards and site of the training data, human-readable."""
        data, boards = (self.training.get(key) for key in ("data", "boards"))
        configurations = self.training.get("configurations")
        extent = f" ({len(configurations)} configurations)" if isinstance(configurations, list) else ""
        return f"trained on {data or 'unknown data'}{extent}, boards {boards or 'unknown'}"

    def __post_init__(self) -> None:
        if self.architecture.samples != self.preprocessing.samples:
            raise ModelError(
                f"the network reads {self.architecture.samples} samples, "
                f"the preprocessing returns {self.preprocessing.samples}"
            )
        numbers = {
            **{f"linear_bias.{name}": value for name, value in asdict(self.linear_bias).items()},
            **{f"correction_limits_m[{n}]": value for n, value in enumerate(self.correction_limits_m)},
            **{f"scale[{n}]": value for n, value in enumerate(chain.from_iterable(self.scale))},
            "variance_m2": self.variance_m2,
            "variance_uncorrected_m2": self.variance_uncorrected_m2,
        }
        for name, value in numbers.items():
            check_float32(name, value)
        for name in ("variance_m2", "variance_uncorrected_m2"):
            if numbers[name] <= 0:
                raise ModelError(f"{name} = {numbers[name]}", valid="a positive number")
        sizes, deviations = np.array(self.scale).T
        if sizes[0] != 0.0 or (np.diff(sizes) <= 0.0).any() or (deviations <= 0.0).any():
            raise ModelError(
                f"scale = {self.scale}", valid="increasing sizes from 0, and positive deviations"
            )
        if not 1.0 <= self.interval95_sigmas <= 1e3:
            raise ModelError(f"interval95_sigmas = {self.interval95_sigmas}", valid="1 to 1000")
        needs_levels = self.ood_bands is not None and self.ood_bands.needs_levels
        if needs_levels and self.preprocessing.scaling is not Scaling.PREAMBLE:
            what = "bands of received powers for windows without a level"
            raise ModelError(what, valid="the scaling preamble")
        if self.correction_limits_m[0] >= self.correction_limits_m[1]:
            raise ModelError(f"correction_limits_m = {self.correction_limits_m}", valid="low, high")


@dataclass(frozen=True, slots=True, eq=False)
class Bundle:
    """A loaded model: card, bytes of the file, and inference session."""

    path: Path
    model: bytes
    model_id: int
    card: ModelCard
    session: onnxruntime.InferenceSession

    def __repr__(self) -> str:
        return f"Bundle({self.name!r}, id {self.model_id:08x}, {str(self.path)!r})"

    def __reduce__(self) -> tuple[Any, ...]:
        return _unpickled, (self.model, self.path)

    @property
    def name(self) -> str:
        """Name of the model."""
        return self.card.name


@lru_cache(8)
def _unpickled(model: bytes, path: Path) -> Bundle:
    """Return a bundle with a new session; one for each process, because a process pool pickles it with every task."""
    return parse_bundle(model, path)


class Session:
    """Runs the network of a bundle, or a serialised ONNX graph of this package."""

    def __init__(self, model: Bundle | bytes) -> None:
        self._session = model.session if isinstance(model, Bundle) else _session(model, "")
        (source,), (result,) = self._session.get_inputs(), self._session.get_outputs()
        self._input, self._outputs = source.name, [result.name]

    def predict_m(self, windows: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the outputs of the network, m, float32 (n,), for inputs float32 (n, K)."""
        output: NDArray[np.float32] = self._session.run(self._outputs, {self._input: windows[:, None, :]})[0]
        return output[:, 0]


def load_bundle(path: Path | str) -> Bundle:
    """Read and check a bundle.

    Raises:
        ModelError: the file is missing, too large, damaged, not an ONNX model, not a bundle of this package, or its
            metadata and its graph are inconsistent.
    """
    path = Path(path)
    return parse_bundle(read_bounded(path, MAX_BYTES, ModelError, _REMEDY), path)


def parse_bundle(data: bytes, path: Path) -> Bundle:
    """Check the bytes of a bundle; errors contain `path`.

    Raises:
        ModelError: see `load_bundle`.
    """
    where = str(path)
    markers = list(_MARKER.finditer(data))
    if len(markers) != 1:
        raise ModelError(f"not an ONNX model with the metadata {METADATA_KEY!r}", where=where, valid=_REMEDY)
    model_id = int(markers[0].group(1), 16)
    actual = _checksum(data, markers[0].start(1))
    if model_id != actual:
        raise ModelError(
            f"the model file is damaged: its checksum is {actual:08x}, its model id {model_id:08x}",
            where=where,
            valid="copy or build the file again",
        )
    session = _session(data, where)
    text = session.get_modelmeta().custom_metadata_map.get(METADATA_KEY, "")
    try:
        card = _card(json.loads(text))
    except (ValueError, KeyError, TypeError, RecursionError, UwbMitigationError) as error:
        reason = f"missing key {error}" if isinstance(error, KeyError) else str(error)
        raise ModelError(f"invalid metadata: {reason}", where=where, valid=_REMEDY) from error
    shapes = [tuple(tensor.shape[1:]) for tensor in (*session.get_inputs(), *session.get_outputs())]
    expected = [(1, card.architecture.samples), (1,)]
    if shapes != expected:
        raise ModelError(
            f"the inputs and outputs of the graph have the shapes {shapes}", where=where, valid=f"{expected}"
        )
    if (b"QuantizeLinear" in data) != card.quantised:
        raise ModelError(
            f"quantised = {card.quantised} in the metadata does not match the graph", where=where
        )
    return Bundle(path, data, model_id, card, session)


def _session(data: bytes, where: str) -> onnxruntime.InferenceSession:
    import onnxruntime

    try:
        return onnxruntime.InferenceSession(data, session_options(), providers=["CPUExecutionProvider"])
    except Exception as error:  # ONNX Runtime's errors have no common base class.
        raise ModelError(
            f"ONNX Runtime {onnxruntime.__version__} rejects the model: {error}", where=where, valid=_REMEDY
        ) from error


def session_options() -> onnxruntime.SessionOptions:
    """Return the options of every session of this package.

    They use one thread: the network takes tens of microseconds, less than waking a second thread.
    """
    # ONNX Runtime takes 0.4 s to import: import it only when a network is run.
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    options.inter_op_num_threads = 1
    options.execution_mode = onnxruntime.ExecutionMode.ORT_SEQUENTIAL
    options.log_severity_level = 4
    return options


def save_bundle(path: Path, graph: bytes, card: ModelCard) -> Bundle:
    """Write a bundle atomically and return it as `load_bundle` would.

    Args:
        path: file to write.
        graph: a serialised ONNX model without the metadata of a bundle.
        card: description of the network.

    Raises:
        ModelError: the card does not fit the graph, or the file cannot be written.
    """
    bundle, data = build_bundle(path, graph, card)
    write_atomically(path, data, ModelError)
    return bundle


def build_bundle(path: Path, graph: bytes, card: ModelCard) -> tuple[Bundle, bytes]:
    """Return a bundle like `save_bundle`, and its bytes, which the caller must write to `path`.

    Raises:
        ModelError: the card does not fit the graph.
    """
    import onnx

    metadata = asdict(card)
    metadata["ood"] = metadata.pop("ood_bands")
    metadata |= {
        "format": FORMAT,
        "model_id": _BLANK.decode(),
        "radios": [radio.name for radio in card.radios],
        "segments": [segment.name for segment in card.segments],
        "architecture": asdict(card.architecture) | {"kind": card.architecture.kind},
        "preprocessing": {"samples": card.preprocessing.samples, "scaling": card.preprocessing.scaling.value},
    }
    if not card.channels:
        del metadata["channels"]
    text = json.dumps(metadata, sort_keys=True, separators=(",", ":"), allow_nan=False)
    try:
        model = onnx.load_model_from_string(graph)
        onnx.helper.set_model_props(model, {METADATA_KEY: text})
        blank: bytes = model.SerializeToString(deterministic=True)
    except Exception as error:  # protobuf's errors are not part of the API of onnx.
        raise ModelError(f"not an ONNX graph: {error}") from error
    (marker,) = _MARKER.finditer(blank)
    start = marker.start(1)
    data = blank[:start] + b"%08x" % _checksum(blank, start) + blank[start + len(_BLANK) :]
    return parse_bundle(data, path), data


def _checksum(data: bytes, digits: int) -> int:
    """Return the CRC-32 of `data` with the eight digits at `digits` set to zero; never 0, which means no model."""
    view = memoryview(data)
    crc = zlib.crc32(view[digits + len(_BLANK) :], zlib.crc32(_BLANK, zlib.crc32(view[:digits])))
    return crc or 1


def _card(metadata: dict[str, Any]) -> ModelCard:
    if metadata["format"] != FORMAT:
        raise ModelError(f"metadata format {metadata['format']!r}", valid=f"{FORMAT}")
    low, high = metadata["correction_limits_m"]
    return ModelCard(
        name=str(metadata["name"]),
        architecture=_architecture(metadata["architecture"]),
        preprocessing=Preprocessing(
            _integer(metadata["preprocessing"]["samples"]), Scaling(metadata["preprocessing"]["scaling"])
        ),
        linear_bias=LinearBiasModel(
            **{key: float(value) for key, value in dict(metadata["linear_bias"]).items()}
        ),
        quantised=metadata["quantised"] is True,
        variance_m2=float(metadata["variance_m2"]),
        variance_uncorrected_m2=float(metadata["variance_uncorrected_m2"]),
        correction_limits_m=(float(low), float(high)),
        training=dict(metadata["training"]),
        scale=tuple((float(size), float(sd)) for size, sd in metadata["scale"]),
        interval95_sigmas=float(metadata["interval95_sigmas"]),
        ood_bands=_ood_bands(metadata["ood"]),
        needs_cir=metadata["needs_cir"] is True,
        early_path=metadata["early_path"] is True,
        radios=tuple(RadioType[str(name)] for name in metadata["radios"]),
        segments=tuple(Segment[str(name)] for name in metadata["segments"]),
        channels=tuple(map(_integer, metadata.get("channels", ()))),
    )


def _ood_bands(metadata: dict[str, Any] | None) -> OodBands | None:
    if metadata is None:
        return None
    bands = dict(metadata)
    offset = float(bands.pop("known_offset_m"))
    return OodBands(offset, **{name: Band(**band) if band else None for name, band in bands.items()})


def _architecture(metadata: dict[str, Any]) -> Architecture:
    shape = dict(metadata)
    kind = shape.pop("kind")
    if kind == "mlp":
        hidden = tuple(_integer(size) for size in shape.pop("hidden"))
        return Mlp(hidden=hidden, **{key: _integer(value) for key, value in shape.items()})
    if kind != "remnet":
        raise ModelError(f"architecture {kind!r}", valid="remnet or mlp")
    return Remnet(**{key: _integer(value) for key, value in shape.items()})


def _integer(value: object) -> int:
    if not isinstance(value, int) or isinstance(value, bool):
        raise ModelError(f"{value!r} is not an integer")
    return value
