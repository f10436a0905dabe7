"""`data fetch`: against a server on this machine, with pooch's own handling of DOIs in place."""

from __future__ import annotations

import contextlib
import hashlib
import json
import threading
from collections.abc import Iterator
from dataclasses import replace
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest
import requests
from command_line import run, start

from uwb_mitigation.errors import ParameterError, RecordingError
from uwb_mitigation.sources import deepuwb
from uwb_mitigation.sources.download import download

CONTENT = bytes(range(256)) * 1000
SHA256 = "sha256:" + hashlib.sha256(CONTENT).hexdigest()
MD5 = "md5:" + hashlib.md5(CONTENT).hexdigest()
REMOTE = replace(deepuwb.PUBLISHED, max_bytes=1_000_000)


class Server(ThreadingHTTPServer):
    """Serves `CONTENT`, in one of a few ways that servers go wrong."""

    daemon_threads = True

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), _Handler)
        self.asked: list[str] = []
        self.cut_first = 0
        self.state_length = True
        self.stated_checksum = MD5

    def url(self, path: str = "/dataset.pkl") -> str:
        return f"http://127.0.0.1:{self.server_address[1]}{path}"


class _Handler(BaseHTTPRequestHandler):
    server: Server

    def do_GET(self) -> None:
        self.server.asked.append(self.path)
        if self.path == "/absent":
            self.send_error(404)
            return
        body = CONTENT
        if self.path == "/api/records/4290069":
            item = {
                "key": "dataset.pkl",
                "checksum": self.server.stated_checksum,
                "links": {"self": self.server.url()},
            }
            body = json.dumps({"id": 4290069, "files": [item]}).encode()
        self.send_response(200)
        if self.server.state_length:
            self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        if self.server.cut_first > 0:
            self.server.cut_first -= 1
            body = body[: len(body) // 2]
        with contextlib.suppress(OSError):  # the client may refuse the rest
            self.wfile.write(body)

    def log_message(self, format: str, *args: Any) -> None:
        """Keep the tests' output free of the server's log."""


@pytest.fixture
def server() -> Iterator[Server]:
    with Server() as running:
        thread = threading.Thread(target=running.serve_forever, args=(0.01,))
        thread.start()
        yield running
        running.shutdown()
        thread.join()


@pytest.fixture
def zenodo(server: Server, monkeypatch: pytest.MonkeyPatch) -> Server:
    """Leads the requests that a DOI causes to `server`, which answers as Zenodo does."""
    get = requests.get

    def led(url: str, **options: Any) -> requests.Response:
        if url == f"https://doi.org/{REMOTE.doi}":
            response = requests.Response()
            response.status_code, response.url = 200, "https://zenodo.org/records/4290069"
            return response
        return get(url.replace("https://zenodo.org", server.url("")), **options)

    monkeypatch.setattr(requests, "get", led)
    return server


@pytest.fixture(autouse=True)
def no_waiting(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("time.sleep", lambda seconds: None)


def only_file(folder: Path) -> str:
    return ", ".join(path.name for path in folder.iterdir())


def test_a_doi_leads_to_the_file_and_to_its_checksum(zenodo: Server, tmp_path: Path) -> None:
    result = download(REMOTE, tmp_path / "deepuwb.pkl")
    assert (tmp_path / "deepuwb.pkl").read_bytes() == CONTENT
    assert (result.checksum, result.fetched) == (MD5, True)
    assert zenodo.asked[0] == "/api/records/4290069"
    assert zenodo.asked[-1] == "/dataset.pkl"
    assert only_file(tmp_path) == "deepuwb.pkl"


def test_what_is_not_what_zenodo_states_is_refused(zenodo: Server, tmp_path: Path) -> None:
    zenodo.stated_checksum = "md5:" + "0" * 32
    with pytest.raises(RecordingError, match="hash"):
        download(REMOTE, tmp_path / "deepuwb.pkl", retries=0)
    assert only_file(tmp_path) == ""


def test_a_mirror_is_checked_against_zenodos_checksum(zenodo: Server, tmp_path: Path) -> None:
    result = download(REMOTE, tmp_path / "deepuwb.pkl", url=zenodo.url("/mirror"))
    assert (result.url, result.checksum) == (zenodo.url("/mirror"), MD5)
    assert zenodo.asked == ["/api/records/4290069", "/mirror"]


def test_a_repository_without_the_file_is_refused(zenodo: Server, tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="checksum cannot be had"):
        download(replace(REMOTE, name="other.pkl"), tmp_path / "other.pkl")


def test_without_a_network_the_error_says_how_to_go_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def unreachable(url: str, **options: Any) -> requests.Response:
        raise requests.ConnectionError("no route to host")

    monkeypatch.setattr(requests, "get", unreachable)
    with pytest.raises(RecordingError, match=r"no route to host .*--url MIRROR --sha256"):
        download(REMOTE, tmp_path / "deepuwb.pkl")


def test_progress_is_told_up_to_the_whole(server: Server, tmp_path: Path) -> None:
    told: list[tuple[int, int | None]] = []
    download(
        REMOTE,
        tmp_path / "a.pkl",
        lambda done, total: told.append((done, total)),
        url=server.url(),
        checksum=SHA256,
    )
    assert told == sorted(told)
    assert len(told) > 1
    assert told[-1] == (len(CONTENT), len(CONTENT))


def test_an_interrupted_download_is_made_again_from_the_start(server: Server, tmp_path: Path) -> None:
    server.cut_first = 2
    result = download(REMOTE, tmp_path / "a.pkl", url=server.url(), checksum=SHA256, retries=2)
    assert result.path.read_bytes() == CONTENT
    assert server.asked == ["/dataset.pkl"] * 3
    assert only_file(tmp_path) == "a.pkl"


@pytest.mark.parametrize("state_length", [True, False])
def test_what_stays_cut_leaves_nothing_behind(server: Server, tmp_path: Path, state_length: bool) -> None:
    server.cut_first, server.state_length = 9, state_length
    with pytest.raises(RecordingError, match="download failed"):
        download(REMOTE, tmp_path / "a.pkl", url=server.url(), checksum=SHA256, retries=1)
    assert only_file(tmp_path) == ""


def test_ctrl_c_leaves_nothing_behind(server: Server, tmp_path: Path) -> None:
    def interrupt(done: int, total: int | None) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        download(REMOTE, tmp_path / "a.pkl", interrupt, url=server.url(), checksum=SHA256)
    assert only_file(tmp_path) == ""


@pytest.mark.parametrize("state_length", [True, False])
def test_a_file_beyond_the_ceiling_is_refused_at_once(
    server: Server, tmp_path: Path, state_length: bool
) -> None:
    server.state_length = state_length
    small = replace(REMOTE, max_bytes=1000)
    with pytest.raises(RecordingError, match="at most 1000 bytes"):
        download(small, tmp_path / "a.pkl", url=server.url(), checksum=SHA256)
    assert len(server.asked) == 1
    assert only_file(tmp_path) == ""


def test_a_file_that_is_there_is_not_fetched_again(server: Server, tmp_path: Path) -> None:
    (tmp_path / "a.pkl").write_bytes(CONTENT)
    result = download(REMOTE, tmp_path / "a.pkl", url=server.url(), checksum=SHA256.upper())
    assert (result.fetched, server.asked) == (False, [])


def test_another_file_is_replaced_only_when_forced_and_only_by_the_right_one(
    server: Server, tmp_path: Path
) -> None:
    target = tmp_path / "a.pkl"
    target.write_bytes(b"mine")
    with pytest.raises(RecordingError, match="--force"):
        download(REMOTE, target, url=server.url(), checksum=SHA256)
    with pytest.raises(RecordingError, match="hash"):
        download(REMOTE, target, url=server.url(), checksum="sha256:" + "0" * 64, force=True, retries=0)
    assert target.read_bytes() == b"mine"
    download(REMOTE, target, url=server.url(), checksum=SHA256, force=True)
    assert target.read_bytes() == CONTENT


@pytest.mark.parametrize(
    "checksum", ["", "sha256:", "sha256:12", "md5:" + "g" * 32, "crc32:00000000", "sha256:" + "0" * 32]
)
def test_a_malformed_checksum_is_refused(tmp_path: Path, checksum: str) -> None:
    with pytest.raises(ParameterError, match="hexadecimal"):
        download(REMOTE, tmp_path / "a.pkl", url="http://127.0.0.1/a", checksum=checksum)


@pytest.mark.parametrize("url", ["file:///etc/passwd", "ftp://127.0.0.1/a", "127.0.0.1/a", ""])
def test_an_address_that_is_not_http_is_refused(tmp_path: Path, url: str) -> None:
    with pytest.raises(ParameterError, match="http://"):
        download(REMOTE, tmp_path / "a.pkl", url=url, checksum=SHA256)


def test_the_command_fetches_and_tells(server: Server, tmp_path: Path) -> None:
    sha256 = SHA256.partition(":")[2]
    done = start(
        "data",
        "fetch",
        "deepuwb",
        "--url",
        server.url(),
        "--sha256",
        sha256,
        "--json",
        "fetch.json",
        folder=tmp_path,
    )
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "deepuwb.pkl").read_bytes() == CONTENT
    assert json.loads((tmp_path / "fetch.json").read_text()) == {
        "output": "deepuwb.pkl",
        "bytes": len(CONTENT),
        "checksum": SHA256,
        "url": server.url(),
        "fetched": True,
    }


def test_the_command_fails_with_one_clear_line(server: Server, tmp_path: Path) -> None:
    done = run(
        "data",
        "fetch",
        "deepuwb",
        "-o",
        "x.pkl",
        "--url",
        server.url("/absent"),
        "--sha256",
        "0" * 64,
        folder=tmp_path,
    )
    assert done.returncode == 1
    assert len(done.stderr.strip().splitlines()) == 1
    assert "404" in done.stderr
    assert only_file(tmp_path) == ""
