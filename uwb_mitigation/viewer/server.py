"""Serve the viewer's page over HTTP from its own thread; the page needs no other server."""

from __future__ import annotations

import asyncio
import hmac
import logging
import secrets
import socket
import threading
from contextlib import AbstractContextManager
from typing import Any
from urllib.parse import quote, unquote

import psutil
from bokeh.application import Application
from bokeh.application.handlers.function import FunctionHandler
from bokeh.server.server import BaseServer
from bokeh.server.tornado import BokehTornado
from bokeh.server.util import bind_sockets, check_allowlist
from tornado.httpserver import HTTPServer
from tornado.httputil import HTTPHeaders, HTTPServerRequest
from tornado.ioloop import IOLoop
from tornado.web import GZipContentEncoding, OutputTransform, RequestHandler

from uwb_mitigation.errors import ParameterError
from uwb_mitigation.viewer.page import Page
from uwb_mitigation.viewer.state import View

ALL_ADDRESSES = ("0.0.0.0", "::", "*")
LOCAL_ADDRESSES = ("localhost", "127.0.0.1", "::1")

_UNKNOWN_HOST = (
    "The viewer does not accept this host name. Set the node's parameter origins, or the option --origins of "
    "`uwb-mitigation view`, to HOST:PORT of this address.\n"
)
_WRONG_TOKEN = "Open the URL that the viewer has printed: it contains a token.\n"

_NONCE, _COOKIE = "X-Nonce", "X-Set-Cookie"
"""Headers that pass the nonce and the cookie of a response; values from the client are replaced."""


class ViewerServer(AbstractContextManager["ViewerServer"]):
    """A page at `url` until `close`.

    Args:
        view: the view that the pages show.
        host, port: address to bind; port 0 selects a free port, and the attribute `port` has its number.
        origins: further `host:port` that are accepted in the headers Host and Origin, for a proxy or a host name.
        token: the URL must contain `?token=` and this text; the page then stores it as a cookie. Empty: no protection;
            `generate`: a random one.

    Attributes:
        url: URL of the page. warning: why other computers could use it; empty: they cannot.

    Raises:
        ParameterError: the address cannot be used.
    """

    def __init__(
        self,
        view: View,
        host: str = "localhost",
        port: int = 5006,
        origins: tuple[str, ...] = (),
        token: str = "",
    ) -> None:
        try:
            sockets, self.port = bind_sockets("" if host in ALL_ADDRESSES else host, port)
        except (OSError, ValueError) as error:
            raise ParameterError(
                f"the page cannot be served at {host}:{port}: {error}",
                valid="a free port, and a name or an address of this machine",
            ) from error
        token = secrets.token_urlsafe(16) if token == "generate" else token
        application = _Application(view, accepted_hosts(host, self.port, origins), token)
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(
            target=self._run, args=(application, sockets), name="viewer", daemon=True
        )
        self._thread.start()
        name = _bracketed("localhost" if host in ALL_ADDRESSES else host)
        self.url = f"http://{name}:{self.port}/" + (f"?token={quote(token)}" if token else "")
        self.warning = ""
        if host not in LOCAL_ADDRESSES and not token:
            self.warning = (
                f"everyone in the network can read the data and control the page at {host}, port {self.port}: "
                "set a token, or use an SSH tunnel"
            )

    def close(self) -> None:
        """Stop serving; may be called twice."""
        if self._thread.is_alive():
            self._loop.call_soon_threadsafe(self._loop.stop)
            self._thread.join()

    def __exit__(self, *_: object) -> None:
        self.close()

    def _run(self, application: _Application, sockets: list[socket.socket]) -> None:
        asyncio.set_event_loop(self._loop)
        # Bokeh warns if a tab is closed while data is sent to it.
        logging.getLogger("bokeh.server.views.ws").setLevel(logging.ERROR)
        http = HTTPServer(application)
        http.add_sockets(sockets)
        server = BaseServer(IOLoop.current(), application, http)
        server.start()
        try:
            self._loop.run_forever()
        finally:
            server.unlisten()
            server.stop()
            # Also close its connections, so that the pages detect it immediately.
            IOLoop.current().close(all_fds=True)


class _Application(BokehTornado):  # type: ignore[misc]
    """Serves only requests that name an accepted host, each with a Content-Security-Policy.

    Without the check of Host, another site could reach the page through a name that it resolves to this computer
    (DNS rebinding).
    """

    def __init__(self, view: View, hosts: list[str], token: str) -> None:
        self._hosts, self._token = hosts, token

        def open_page(document: Any) -> None:
            Page(document, view, document.session_context.request.headers.get(_NONCE, ""))

        super().__init__(
            {"/": Application(FunctionHandler(open_page))},
            extra_websocket_origins=self._hosts,
            # Discard sessions of closed tabs soon, so that they use no resources.
            check_unused_sessions_milliseconds=1000,
            unused_session_lifetime_milliseconds=2000,
        )
        self.add_transform(GZipContentEncoding)
        self.add_transform(_SecurityPolicy)

    def find_handler(self, request: HTTPServerRequest, **kwargs: Any) -> Any:
        request.headers[_NONCE] = secrets.token_urlsafe(16)
        request.headers.pop(_COOKIE, None)
        if not check_allowlist(request.host.lower(), self._hosts):
            return self.get_handler_delegate(request, _Refusal, {"reason": _UNKNOWN_HOST})
        if self._token and not self._is_authorised(request):
            return self.get_handler_delegate(request, _Refusal, {"reason": _WRONG_TOKEN})
        return super().find_handler(request, **kwargs)

    def _is_authorised(self, request: HTTPServerRequest) -> bool:
        """Return whether a request has the token in its URL or in its cookie; the cookie belongs to this port."""
        name = f"uwb_token_{request.host.rpartition(':')[2]}"
        tokens = [value.decode("utf-8", "replace") for value in request.query_arguments.get("token", [])]
        if any(hmac.compare_digest(text.encode(), self._token.encode()) for text in tokens):
            request.headers[_COOKIE] = f"{name}={quote(self._token)}; HttpOnly; SameSite=Strict; Path=/"
            return True
        cookie = request.cookies.get(name)
        return cookie is not None and hmac.compare_digest(
            unquote(cookie.value).encode(), self._token.encode()
        )


class _SecurityPolicy(OutputTransform):  # type: ignore[misc]
    """Adds the Content-Security-Policy to every response.

    Only scripts of this server and inline scripts with the nonce run. Bokeh needs inline styles, and `data:` for its icons.
    """

    def __init__(self, request: HTTPServerRequest) -> None:
        # Some browsers do not count a websocket as 'self'.
        self._cookie = request.headers.get(_COOKIE, "")
        self._policy = (
            f"default-src 'none'; script-src 'self' 'nonce-{request.headers[_NONCE]}'; style-src 'self' 'unsafe-inline'; "
            f"img-src 'self' data: blob:; font-src 'self' data:; connect-src 'self' ws://{request.host} "
            f"wss://{request.host}; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
        )

    def transform_first_chunk(
        self, status_code: int, headers: HTTPHeaders, chunk: bytes, finishing: bool
    ) -> tuple[int, HTTPHeaders, bytes]:
        headers["Content-Security-Policy"] = self._policy
        headers["X-Content-Type-Options"] = "nosniff"
        headers["Referrer-Policy"] = "no-referrer"
        if self._cookie:
            headers["Set-Cookie"] = self._cookie
        return status_code, headers, chunk


class _Refusal(RequestHandler):  # type: ignore[misc]
    """Answers requests that are not accepted."""

    def initialize(self, reason: str) -> None:
        self._text = reason

    def prepare(self) -> None:
        self.set_status(403)
        self.finish(self._text)


def accepted_hosts(host: str, port: int, more: tuple[str, ...]) -> list[str]:
    """Return the `host:port` that requests may name as Host and as Origin.

    With the wildcard address, these are the addresses and the name of this machine; no other site can resolve to them.
    """
    names = {"localhost", "127.0.0.1"}
    if host in ALL_ADDRESSES:
        own, families = socket.gethostname().lower(), (socket.AF_INET, socket.AF_INET6)
        entries = [entry for interface in psutil.net_if_addrs().values() for entry in interface]
        # A browser omits the zone of an IPv6 address.
        addresses = {entry.address.partition("%")[0] for entry in entries if entry.family in families}
        names |= {own, f"{own}.local"} | addresses
    else:
        names.add(host.lower())
    return [*(f"{_bracketed(name)}:{port}" for name in sorted(names)), *(origin.lower() for origin in more)]


def _bracketed(name: str) -> str:
    """Return a name or an address as in a URL."""
    return f"[{name}]" if ":" in name else name
