"""`metadata.yaml` of rosbag2: the files of a bag folder and their contents."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import Any

import yaml

from uwb_mitigation.errors import RecordingError
from uwb_mitigation.files import read_bounded

METADATA_NAME = "metadata.yaml"
VERSION = 9
"""Version of rosbag2's metadata in Jazzy."""

MAX_METADATA = 4 << 20
"""Maximum size of a `metadata.yaml`, bytes."""

NO_QOS = "[]"
"""No recorded QoS: `ros2 bag play` offers its default (reliable, volatile)."""


def topic_metadata(
    topic: str, type_name: str, type_hash: str, qos: Sequence[Mapping[str, Any]]
) -> dict[str, Any]:
    """Return the description of a topic in `metadata.yaml`."""
    return {
        "name": topic,
        "type": type_name,
        "serialization_format": "cdr",
        "offered_qos_profiles": qos,
        "type_description_hash": type_hash,
    }


def recorded_qos(text: str) -> list[dict[str, Any]]:
    """Return the offered QoS in a channel's metadata, in the format of this metadata version.

    Earlier versions of rosbag2 write numbers instead of names. Empty if it cannot be parsed.
    """
    # Import only if a bag is copied: the import takes a quarter of the start-up time of a driver.
    from rosbags.rosbag2.errors import ReaderError
    from rosbags.rosbag2.metadata import dump_qos_v9, parse_qos

    try:
        return [dict(profile) for profile in dump_qos_v9(parse_qos(text[:MAX_METADATA]))]
    except (ReaderError, LookupError, TypeError, ValueError, AttributeError):
        return []


def describe(
    file_name: str,
    topics: Sequence[dict[str, Any]],
    counts: Counter[str],
    bounds_ns: tuple[int, int],
    custom: Mapping[str, str],
) -> dict[str, Any]:
    """Return the content of `metadata.yaml` below its only key, for a bag of one file; `topics`: of `topic_metadata`."""
    start = {"nanoseconds_since_epoch": bounds_ns[0]}
    duration = {"nanoseconds": bounds_ns[1] - bounds_ns[0]}
    total = counts.total()
    return {
        "version": VERSION,
        "storage_identifier": "mcap",
        "duration": duration,
        "starting_time": start,
        "message_count": total,
        "topics_with_message_count": [
            {"topic_metadata": topic, "message_count": counts[topic["name"]]} for topic in topics
        ],
        "compression_format": "",
        "compression_mode": "",
        "relative_file_paths": [file_name],
        "files": [{"path": file_name, "starting_time": start, "duration": duration, "message_count": total}],
        "custom_data": dict(custom) or None,
        "ros_distro": "jazzy",
    }


def dump(document: Mapping[str, Any] | Sequence[Any]) -> str:
    """Return YAML in the order of the keys and, like rosbag2, without YAML anchors."""
    return yaml.dump(document, Dumper=_NoAliasDumper, sort_keys=False, allow_unicode=True)


def listed_files(folder: Path) -> list[str] | None:
    """Return the file names in `folder/metadata.yaml`; None = there is no such file.

    Raises:
        RecordingError: it cannot be read, is malformed, or describes storage other than MCAP.
    """
    path = folder / METADATA_NAME
    if not path.exists():
        return None
    text = read_bounded(path, MAX_METADATA, RecordingError, "a rosbag2 metadata file")
    try:
        information = yaml.safe_load(text)["rosbag2_bagfile_information"]
        storage = information["storage_identifier"]
        paths = information["relative_file_paths"]
        compression = information.get("compression_mode") or ""
        names = [PurePosixPath(entry).name for entry in paths]
    except (yaml.YAMLError, RecursionError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise RecordingError(
            "not a rosbag2 metadata file", where=path, valid="remove it to read every *.mcap next to it"
        ) from error
    if storage != "mcap":
        raise _unsupported_storage(folder, str(storage))
    if str(compression).lower() == "file":
        raise RecordingError(
            "the files of the bag are compressed in file mode",
            where=path,
            valid=_conversion_hint(folder),
        )
    return names


def bag_files(path: Path) -> list[Path]:
    """Return the MCAP files of a bag, in order: for a folder those in its `metadata.yaml`, otherwise every `*.mcap`.

    Raises:
        RecordingError: the path does not exist or contains no MCAP file.
    """
    if not path.is_dir():
        if path.suffix == ".db3":
            raise _unsupported_storage(path, "sqlite3")
        if not path.exists():
            raise RecordingError("no such file or folder", where=path)
        if not path.is_file():
            raise RecordingError("not a regular file", where=path)
        return [path]
    names = listed_files(path)
    if names is None:
        paths = (entry.name for entry in path.glob("*.mcap") if entry.is_file())
        names = sorted(paths, key=_natural_sort_key)
        if not names and any(path.glob("*.db3")):
            raise _unsupported_storage(path, "sqlite3")
    # Ignore the directory part of a listed name: the file must be in this folder.
    files = [path / name for name in names if name]
    if not files:
        raise RecordingError("the folder contains no MCAP file", where=path)
    for file in files:
        if not file.is_file():
            raise RecordingError(f"{METADATA_NAME} lists a missing file", where=file)
    return files


def _natural_sort_key(name: str) -> list[tuple[int, str]]:
    """Return a natural sort key: bag_10 follows bag_9."""
    return [(int(piece), "") if piece.isdecimal() else (-1, piece) for piece in re.split(r"([0-9]+)", name)]


def _unsupported_storage(path: Path, storage: str) -> RecordingError:
    return RecordingError(
        f"the bag is stored as {storage[:32]}, not as MCAP", where=path, valid=_conversion_hint(path)
    )


def _conversion_hint(path: Path) -> str:
    return (
        f"convert it: ros2 bag convert -i {path} -o OPTIONS.yaml, where OPTIONS.yaml says "
        "output_bags: [{uri: NEW_BAG, storage_id: mcap, all_topics: true}]"
    )


class _NoAliasDumper(yaml.SafeDumper):
    def ignore_aliases(self, data: object) -> bool:
        return True
