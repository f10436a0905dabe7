"""Bundles: written ones are read back, and damaged or other files are refused."""

import json
import random
import zlib
from pathlib import Path

import numpy as np
import onnx
import pytest
from model_material import bundle, card, random_weights

from uwb_mitigation.errors import ModelError
from uwb_mitigation.mitigation.model import bundle as bundles
from uwb_mitigation.mitigation.model import graph
from uwb_mitigation.mitigation.model.architecture import Remnet
from uwb_mitigation.mitigation.model.bundle import load_bundle, parse_bundle, save_bundle
from uwb_mitigation.mitigation.model.linear_bias import LinearBiasModel
from uwb_mitigation.mitigation.model.shipped import SHIPPED, shipped_model_path
from uwb_mitigation.types.measurement import RadioType, Segment

SHAPE = Remnet(samples=16, filters=4)
CARD = {
    # Numbers that a decimal representation must keep to the bit.
    "linear_bias": LinearBiasModel(*(float(np.float32(value)) for value in (0.1, -1e-7, 1 / 3))),
    "variance_m2": float(np.float32(0.3)),
    "radios": (RadioType.DW3000, RadioType.QM35),
    "segments": (Segment.STS,),
    "channels": (5, 9),
}


@pytest.fixture(scope="module")
def saved(tmp_path_factory) -> bundles.Bundle:
    return bundle(tmp_path_factory.mktemp("bundle"), SHAPE, **CARD)


def refused(data: bytes) -> bool:
    """Return whether `parse_bundle` raises a ModelError that names the file."""
    with pytest.raises(ModelError) as caught:
        parse_bundle(data, Path("some.onnx"))
    return caught.value.where == "some.onnx"


def with_metadata(data: bytes, change) -> bytes:
    """Return a bundle with changed metadata and a valid checksum."""
    model = onnx.load_model_from_string(data)
    metadata = json.loads(model.metadata_props[0].value)
    change(metadata)
    metadata["model_id"] = "00000000"
    model.metadata_props[0].value = json.dumps(metadata, sort_keys=True, separators=(",", ":"))
    return sealed(model)


def sealed(model: onnx.ModelProto) -> bytes:
    data = model.SerializeToString()
    start = data.index(b'"model_id":"') + len(b'"model_id":"')
    blank = data[:start] + b"00000000" + data[start + 8 :]
    return data[:start] + b"%08x" % zlib.crc32(blank) + data[start + 8 :]


def test_saved_bundle_is_loaded_unchanged(saved):
    loaded = load_bundle(saved.path)
    assert loaded.card == saved.card == card(SHAPE, **CARD)
    assert loaded.model_id == saved.model_id
    assert loaded.model == saved.path.read_bytes()


def test_any_changed_byte_or_truncation_is_detected(saved):
    generator = random.Random(1)
    for _ in range(400):
        damaged = bytearray(saved.model)
        damaged[generator.randrange(len(damaged))] ^= 1 << generator.randrange(8)
        assert refused(bytes(damaged))
    assert all(refused(saved.model[:length]) for length in range(97, len(saved.model), 97))


def test_huge_file_is_refused_without_reading_it(tmp_path):
    path = tmp_path / "huge.onnx"
    with path.open("wb") as file:
        file.truncate(1 << 40)
    with pytest.raises(ModelError, match="more than 67108864 bytes"):
        load_bundle(path)


def test_graph_that_onnx_runtime_cannot_run_is_refused(saved):
    model = onnx.load_model_from_string(saved.model)
    model.graph.node[0].domain = "other"
    assert refused(sealed(model))


@pytest.mark.parametrize(
    "change",
    [
        lambda m: m.update(format=2),
        lambda m: m.pop("linear_bias"),
        lambda m: m.pop("radios"),
        lambda m: m["preprocessing"].update(scaling="log"),
        lambda m: m["preprocessing"].update(samples=32),
        lambda m: m["architecture"].update(samples="16"),
        lambda m: m["architecture"].update(depth=1),
        lambda m: m["linear_bias"].update(offset_m=1e400),
        lambda m: m.update(variance_m2=-1),
        lambda m: m.update(correction_limits_m=[1, 0]),
        lambda m: m.update(scale=[[1.0, 0.25]]),
        lambda m: m.update(scale=[[0.0, 0.25], [0.0, 0.5]]),
        lambda m: m.update(interval95_sigmas=0.5),
        lambda m: m.update(quantised=False),
        lambda m: m.update(training=3),
        lambda m: m["architecture"].update(samples=32) or m["preprocessing"].update(samples=32),
    ],
)
def test_inconsistent_metadata_is_refused(saved, change):
    assert refused(with_metadata(saved.model, change))


def test_card_that_contradicts_its_graph_is_not_written(tmp_path):
    path = tmp_path / "wrong.onnx"
    with pytest.raises(ModelError):
        save_bundle(path, graph.float_model(random_weights(SHAPE)), card(SHAPE))
    assert not path.exists()


@pytest.mark.parametrize("name", SHIPPED)
def test_model_card_is_of_the_shipped_model(name):
    shipped = shipped_model_path(name)
    text = shipped.with_suffix(".md").read_text(encoding="utf-8")
    assert f"Model id `{load_bundle(shipped).model_id:08x}`" in text
    assert f"{shipped.stat().st_size:,} bytes" in text
