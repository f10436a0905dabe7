"""The node `mitigator`: subscribes to `/uwb/range_raw`, publishes `/uwb/range_corrected`."""

from __future__ import annotations

import importlib.util
import re
import threading
import time
from array import array
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from typing import Any

import numpy as np
from rclpy.duration import Duration
from rclpy.publisher import Publisher
from rclpy.serialization import deserialize_message, serialize_message
from rclpy.subscription import Subscription
from uwb_mitigation_msgs.msg import RangeCir, RangeCorrected

from uwb_mitigation.errors import RecordingError, UwbMitigationError, format_id
from uwb_mitigation.mitigation.correction import Corrector, Mitigation
from uwb_mitigation.mitigation.model.bundle import Bundle
from uwb_mitigation.mitigation.model.choice import CirKind, choose_model
from uwb_mitigation.mitigation.model.linear_bias import LinearBiasModel
from uwb_mitigation.mitigation.model.shipped import load_model
from uwb_mitigation.mitigation.preprocessing import WINDOW_LEAD, Scaling
from uwb_mitigation.nodes.support import diagnostics, endpoints
from uwb_mitigation.nodes.support.endpoints import BATCH
from uwb_mitigation.nodes.support.lifecycle import ManagedNode, refuse_errors
from uwb_mitigation.nodes.support.mitigator_health import ALL_REJECTED, MitigatorHealth
from uwb_mitigation.nodes.support.sensor_ranges import SensorRanges
from uwb_mitigation.types.measurement import (
    LINE_OF_SIGHT_DB,
    Cir,
    Encoding,
    RadioType,
    RangeMeasurement,
    Segment,
    Status,
)
from uwb_mitigation.types.offsets import NO_OFFSETS, Offsets, read_offsets
from uwb_mitigation.types.ros import topics
from uwb_mitigation.types.ros.codec import decode_range, encode_corrected

# ONNX Runtime is imported later: fail early if it is missing.
if importlib.util.find_spec("onnxruntime") is None:
    raise ModuleNotFoundError("No module named 'onnxruntime'", name="onnxruntime")


def load_corrector(model: str, backend: str = "onnxruntime") -> Corrector:
    """Return the model or models of the parameter `model`, ready to correct by `backend`.

    Raises:
        ModelError: a model is missing, corrupt, or refused by the backend.
        MissingDependencyError: `firmware` without a C compiler.
    """
    bundles = load_model(model)
    if backend == "firmware":
        # Import on demand: it compiles C code.
        from uwb_mitigation.mitigation.embedded.compiled import FirmwareMitigation

        corrector: Corrector = FirmwareMitigation(bundles)
    else:
        corrector = Mitigation(bundles, median_at_rest=True)
    _warm_up(corrector)
    return corrector


def _warm_up(corrector: Corrector) -> None:
    """Correct single ranges and a batch, because the first calls of ONNX Runtime and NumPy are slow."""
    for card in (bundle.card for bundle in corrector.bundles):
        samples = np.zeros(2 * 2 * card.preprocessing.samples, np.int16)
        samples[2 * WINDOW_LEAD] = 10_000
        preamble_count = 128 if card.preprocessing.scaling is Scaling.PREAMBLE else 0
        cir = Cir(samples, first_path_index=WINDOW_LEAD, preamble_count=preamble_count, rx_power_dbm=-80.0,
                  first_path_power_dbm=-81.0, radio=card.radios[0], segment=card.segments[0])  # fmt: skip
        measurement = RangeMeasurement(0, 1, 1, 0, 0, 5.0, cir)
        for count in (1, 1, BATCH):
            corrector.correct([measurement] * count)


class Mitigator(ManagedNode):
    """Lifecycle: configure creates publisher and subscription, activate loads the model.

    If the model cannot be loaded, the node stays inactive, and log and diagnostics name the reason; activate it again
    after the file is fixed. While inactive, nothing is published or queued. Ranges come from the topic or, in one
    process with their driver, through `correct`.

    Args:
        subscribe: whether to subscribe to the topic of raw ranges.
    """

    def __init__(self, *, subscribe: bool = True) -> None:
        super().__init__("mitigator")
        self.health = MitigatorHealth(lambda: self._raw.get_publisher_count() if self._raw else 0)
        self._subscribe = subscribe
        self._raw: Subscription | None = None
        self._corrected: Publisher | None = None
        self._sensor_ranges: SensorRanges
        self._mitigation: Corrector | None = None
        self._prepared: tuple[str, Corrector] | None = None
        self._shipped: tuple[Bundle, ...] = ()
        self._advised = ""
        self._offsets = NO_OFFSETS
        self._prepared_offsets: Offsets | None = None
        # A driver in the same process calls `correct` from its own thread; transitions run in the executor's.
        self._lock = threading.Lock()
        self._meter = diagnostics.RateMonitor(self.now_ns)
        self._reasons: set[str] = set()
        refuse_errors(self, self._prepare)
        self.add_post_set_parameters_callback(self._swap)
        self.autostart()

    def open(self) -> None:
        self._corrected = self.publisher(RangeCorrected, topics.RANGE_CORRECTED)
        self._sensor_ranges = SensorRanges(self)
        if self._subscribe:
            # Subscribe to serialised messages: decoding them here takes a third of the time of rclpy.
            name = topics.relative(topics.RANGE_RAW)
            raw = endpoints.create_raw_subscription(self, RangeCir, name, self._on_raw, self._on_lost)
            self._raw = self.destroy_at_close(raw, self.destroy_subscription)

    def begin(self) -> None:
        self._offsets = read_offsets(str(self.value("offsets")))
        self._use(load_corrector(self.value("model"), self.value("backend")))

    def end(self) -> None:
        with self._lock:
            self._mitigation = None

    def close(self) -> None:
        super().close()
        self._raw = self._corrected = None

    def correct(self, measurements: Sequence[RangeMeasurement]) -> None:
        """Publish the corrected ranges of measurements; while inactive, do nothing."""
        began_ns = time.perf_counter_ns()
        with self._lock:
            mitigation, publisher = self._mitigation, self._corrected
            if mitigation is None or publisher is None:
                return
            results = mitigation.correct(measurements)
            for measurement, corrected in zip(measurements, results, strict=True):
                publisher.publish(encode_corrected(measurement, corrected))
                m = measurement
                self._sensor_ranges.publish(m.anchor_id, m.stamp_ns, m.frame_id, corrected)
            now_ns = self.now_ns()
            self.health.add_time(time.perf_counter_ns() - began_ns)
            pairs = [m.tag_id for m in measurements], [m.anchor_id for m in measurements]
            offsets_m = mitigation.offsets.lookup(*pairs).tolist()
            for measurement, corrected, offset_m in zip(measurements, results, offsets_m, strict=True):
                choice = mitigation.choose(CirKind.of(measurement.cir))
                if self.health.add(choice, measurement, corrected.status) and len(mitigation.bundles) > 1:
                    first = f"tag {format_id(measurement.tag_id)}, anchor {format_id(measurement.anchor_id)}"
                    if choice.fits:
                        self.get_logger().info(f"ranges of {choice} (first: {first})")
                    else:
                        self.get_logger().warning(f"ranges are not corrected: {choice} (first: {first})")
                is_bad = corrected.status is Status.BAD_CIR
                # Once for each kind of reason, whatever its numbers are.
                if is_bad and (kind := re.sub(r"[\d.,]+", "", corrected.reason)) not in self._reasons:
                    self._reasons.add(kind)
                    self.get_logger().warning(f"ranges with status BAD_CIR: {corrected.reason}")
                if corrected.status is Status.OK and measurement.cir.power_gap_db < LINE_OF_SIGHT_DB:
                    self.health.los_m.append(corrected.correction_m - offset_m)
                self._meter.add(now_ns - measurement.stamp_ns)

    def subscription_count(self) -> int:
        """Return the number of subscribers of the corrected ranges."""
        return self._corrected.get_subscription_count() if self._corrected is not None else 0

    def wait_for_all_acked(self, timeout: Duration) -> None:
        """Wait until every subscriber has received everything."""
        if self._corrected is not None:
            self._corrected.wait_for_all_acked(timeout)

    def describe(self) -> diagnostics.Description:
        warnings, entries, failed = self.health.period()
        level, text = diagnostics.OK, "correcting"
        if (mitigation := self._mitigation) is not None:
            bundles, rejected = mitigation.bundles, self.health.rejected
            if ALL_REJECTED.text in warnings and len(bundles) == 1 and rejected is not None:
                warnings.append(self._advice(bundles[0], CirKind.of(rejected)))
            entries |= {
                "model": ", ".join(bundle.card.label for bundle in bundles),
                "model id": ", ".join(diagnostics.model_id(bundle.model_id) for bundle in bundles),
                "offsets": str(mitigation.offsets),
            }
            if pairs := list(self.health.pairs.items()):
                entries["models by radio"] = "; ".join(
                    f"{choice} (tag-anchor {', '.join(f'{format_id(t)}-{format_id(a)}' for t, a in sorted(ids))})"
                    for choice, ids in pairs
                )
        if warnings:
            level, text = diagnostics.WARN, "; ".join(warnings)
        if failed:
            level, text = diagnostics.ERROR, "the model fails on some ranges"
        return "host", level, text, entries | self._meter.entries()

    def _advice(self, bundle: Bundle, rejected: CirKind) -> str:
        """Return, and log once, which shipped model fits ranges that the named one rejects."""
        if not self._shipped:
            with suppress(UwbMitigationError):
                self._shipped = load_model()
        advice = f"the model is {bundle.name}; with model:=auto: {choose_model(self._shipped, rejected)}"
        if advice != self._advised:
            self.get_logger().warning(f"every range is rejected: {advice}")
        self._advised = advice
        return advice

    def _on_raw(self, messages: Iterator[tuple[bytes, int]]) -> None:
        # Subscriptions stay active while a lifecycle node is inactive.
        if self._mitigation is None:
            return
        batch = []
        for data, sequence in messages:
            self.health.loss_counter.add(sequence)
            measurement = self._decode(data)
            if measurement is not None:
                batch.append(measurement)
        if batch:
            self.correct(batch)

    def _decode(self, data: bytes) -> RangeMeasurement | None:
        try:
            return decode_range(data)
        except RecordingError:
            pass
        # rclpy may be able to decode another byte order, and the range next to an encoding of a later version.
        try:
            message = deserialize_message(data, RangeCir)
            cir = message.cir
            kinds = (cir.encoding, Encoding), (cir.radio, RadioType), (cir.segment, Segment)
            if any(value not in tuple(kind) for value, kind in kinds):
                cir.encoding, cir.samples = int(Encoding.COMPLEX_INT16), array("h")
                cir.radio = cir.segment = 0
            return decode_range(serialize_message(message))
        except Exception as error:  # rclpy raises various types, and no message may end the node.
            self.health.malformed += 1
            self.get_logger().warning(f"a message cannot be read: {error}", throttle_duration_sec=10.0)
            return None

    def _on_lost(self, info: Any) -> None:
        self.health.lost += info.total_count_change

    def _use(self, mitigation: Corrector) -> None:
        # Swap between two ranges, so that none is lost or corrected with parts of two models.
        mitigation.offsets = self._offsets
        with self._lock:
            self._mitigation = mitigation
            self.health.reset_model()
        self._reset_offset_check(mitigation)
        bundle, labels = mitigation.bundle, [model_bundle.card.label for model_bundle in mitigation.bundles]
        model = f"{bundle.name}, id {diagnostics.model_id(bundle.model_id)}; {bundle.card.origin}"
        if len(labels) > 1:
            model = f"auto: the first of {', '.join(labels)} that fits"
        limits = "; it may increase errors of other boards and at other sites"
        if bundle.card.linear_bias == LinearBiasModel(0.0):
            limits = f"; offsets of these radios: {self._offsets}"
        self.get_logger().info(f"correcting with model {model}{limits}")

    def _reset_offset_check(self, mitigation: Corrector) -> None:
        # A linear bias model includes the offset of the boards of its training, unless another offset is set.
        self.health.excludes_offset = bool(
            self._offsets
        ) or mitigation.bundle.card.linear_bias == LinearBiasModel(0.0)
        self.health.los_m.clear()

    def _prepare(self, values: Mapping[str, Any]) -> None:
        """Load a new model or new offsets, or raise; ranges wait in the queue meanwhile."""
        if "offsets" in values:
            self._prepared_offsets = read_offsets(str(values["offsets"]))
        if isinstance(model := values.get("model"), str):
            self._prepared = model, load_corrector(model, self.value("backend"))

    def _swap(self, changes: list[Any]) -> None:
        # ROS calls this after all callbacks accepted the set; one may refuse it after `_prepare`.
        prepared, self._prepared = self._prepared, None
        offsets, self._prepared_offsets = self._prepared_offsets, None
        for change in changes:
            if change.name == "offsets" and offsets is not None:
                with self._lock:
                    self._offsets = offsets
                    if self._mitigation is not None:
                        self._mitigation.offsets = offsets
                        self._reset_offset_check(self._mitigation)
                self.get_logger().info(f"offsets: {offsets}")
            if change.name == "model" and prepared is not None and prepared[0] == change.value:
                self.error = None
                if self._mitigation is not None:
                    self._use(prepared[1])
