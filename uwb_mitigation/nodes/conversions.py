"""Between this package's values and the ROS messages of `uwb_mitigation_msgs`.

rclpy does not check field types unless told to, and a wrong one is sent as garbage: every assignment
here converts explicitly. Raw and corrected ranges of the host are serialised by `bag.codec` instead.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from builtin_interfaces.msg import Time
from std_msgs.msg import Header
from uwb_mitigation_msgs.msg import RangeCir, RangeCorrected, RangeTruth

from uwb_mitigation.measurement import Cir, CorrectedRange, Encoding, Origin, RangeMeasurement, Status, Truth

if TYPE_CHECKING:
    from uwb_mitigation.link.messages import Correction

NANOSECONDS = 1_000_000_000
_COMPLEX = Encoding.COMPLEX_INT16
_ENCODINGS = {int(encoding): encoding for encoding in Encoding}


def to_header(stamp_ns: int, frame_id: str) -> Header:
    seconds, nanoseconds = divmod(stamp_ns, NANOSECONDS)
    return Header(stamp=Time(sec=seconds, nanosec=nanoseconds), frame_id=frame_id)


def from_range_cir(message: RangeCir) -> RangeMeasurement:
    """The measurement in a message; its samples are a view of the message's.

    An encoding that this version does not know leaves the measurement without a CIR.
    """
    cir = message.cir
    encoding = _ENCODINGS.get(cir.encoding)
    samples = np.frombuffer(cir.samples, np.int16)
    return RangeMeasurement(
        stamp_ns=message.header.stamp.sec * NANOSECONDS + message.header.stamp.nanosec,
        tag_id=message.tag_id,
        anchor_id=message.anchor_id,
        sequence=message.sequence,
        device_time=message.device_time,
        range_m=message.range,
        cir=Cir(
            samples=samples if encoding is not None else samples[:0],
            encoding=_COMPLEX if encoding is None else encoding,
            start_index=cir.start_index,
            first_path_index=cir.first_path_index,
            sample_period_s=cir.sample_period,
            scale=cir.scale,
            preamble_count=cir.preamble_count,
            noise_threshold=cir.noise_threshold,
            rx_power_dbm=cir.rx_power,
            first_path_power_dbm=cir.first_path_power,
            channel=cir.channel,
            prf_mhz=cir.prf,
        ),
        frame_id=message.header.frame_id,
    )


def to_range_corrected(correction: Correction, header: Header) -> RangeCorrected:
    """The message of a range that a board corrected."""
    corrected = correction.corrected
    return RangeCorrected(
        header=header,
        tag_id=correction.tag_id,
        anchor_id=correction.anchor_id,
        sequence=correction.sequence,
        range=float(corrected.range_m),
        range_raw=float(corrected.range_raw_m),
        correction=float(corrected.correction_m),
        variance=float(corrected.variance_m2),
        status=int(corrected.status),
        source=int(corrected.origin),
        model_id=int(corrected.model_id),
    )


def from_range_corrected(message: RangeCorrected) -> CorrectedRange:
    """The corrected range in a message; its status and source must be known ones.

    Raises:
        ValueError: they are not.
    """
    return CorrectedRange(
        range_m=message.range,
        range_raw_m=message.range_raw,
        correction_m=message.correction,
        variance_m2=message.variance,
        status=Status(message.status),
        origin=Origin(message.source),
        model_id=message.model_id,
    )


def key_of(message: RangeCir | RangeCorrected | RangeTruth) -> tuple[int, ...]:
    """What identifies an exchange on every topic."""
    stamp = message.header.stamp
    return (stamp.sec, stamp.nanosec, message.anchor_id, message.tag_id, message.sequence)


def to_range_truth(truth: Truth, measurement: RangeMeasurement, header: Header) -> RangeTruth:
    return RangeTruth(
        header=header,
        tag_id=measurement.tag_id,
        anchor_id=measurement.anchor_id,
        sequence=measurement.sequence,
        range=float(truth.range_m),
        label=truth.label,
        configuration=truth.configuration,
    )
