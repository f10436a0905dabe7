"""Serves the viewer's page over http from a thread of its own, with everything that the page needs: no network."""

from __future__ import annotations

import asyncio
import html
import logging
import queue
import secrets
import threading
from collections.abc import Callable, Mapping
from typing import Any

from bokeh.application import Application
from bokeh.application.handlers.function import FunctionHandler
from bokeh.server.server import BaseServer
from bokeh.server.tornado import BokehTornado
from bokeh.server.util import bind_sockets, check_allowlist, create_hosts_allowlist
from tornado.httpserver import HTTPServer
from tornado.httputil import HTTPHeaders, HTTPServerRequest
from tornado.ioloop import IOLoop
from tornado.web import OutputTransform, RequestHandler

from uwb_mitigation.errors import ParameterError
from uwb_mitigation.viewer.page import Page
from uwb_mitigation.viewer.view import View

Parameters = Callable[[], Mapping[str, Mapping[str, object]]]
"""{node: {parameter: value}}; called from the server's thread."""


EVERY = ("0.0.0.0", "*")
"""Hosts that mean every address of this machine."""


class ViewerServer:
    """A page at `url` until `close`.

    Args:
        view: what the pages show.
        host, port: where to listen; port 0 takes a free one, which `port` then tells.
        origins: further `host:port` that are accepted in the headers Host and Origin, for a proxy or a host name.
        parameters: what `/parameters` shows.

    Raises:
        ParameterError: the address cannot be listened on.
    """

    def __init__(
        self,
        view: View,
        host: str = "localhost",
        port: int = 5006,
        origins: tuple[str, ...] = (),
        parameters: Parameters | None = None,
    ) -> None:
        view.parameters = parameters is not None
        self._loop: IOLoop | None = None
        outcome: queue.Queue[int | Exception] = queue.Queue()
        self._thread = threading.Thread(
            target=self._run,
            args=(outcome, view, host, port, origins, parameters),
            name="viewer",
            daemon=True,
        )
        self._thread.start()
        found = outcome.get()
        if isinstance(found, Exception):
            if not isinstance(found, OSError | ValueError):
                raise found
            raise ParameterError(
                f"the page cannot be served at {host}:{port}: {found}",
                valid="a free port, and a name or an IPv4 address of this machine",
            ) from found
        self.port = found
        # Every address is none that a browser could name.
        self.url = f"http://{'localhost' if host in EVERY else host}:{self.port}/"

    def close(self) -> None:
        """Stop serving; may be called twice."""
        loop, self._loop = self._loop, None
        if loop is not None:
            loop.add_callback(loop.stop)
            self._thread.join()

    def __enter__(self) -> ViewerServer:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _run(
        self,
        outcome: queue.Queue[int | Exception],
        view: View,
        host: str,
        port: int,
        origins: tuple[str, ...],
        parameters: Parameters | None,
    ) -> None:
        asyncio.set_event_loop(asyncio.new_event_loop())
        # A tab that is closed while data is sent to it is not worth a warning.
        logging.getLogger("bokeh.server.views.ws").setLevel(logging.ERROR)
        loop = IOLoop.current()
        sockets = []
        try:
            sockets, port = bind_sockets("" if host in EVERY else host, port)
            application = _Application(view, _hosts(host, port, origins), parameters)
            http = HTTPServer(application)
            http.add_sockets(sockets)
            server = BaseServer(loop, application, http)
        except Exception as error:
            for listening in sockets:
                listening.close()
            outcome.put(error)
            return
        self._loop = loop
        server.start()
        loop.add_callback(outcome.put, port)
        try:
            loop.start()
        finally:
            server.unlisten()
            server.stop()
            # Its connections too, so that pages learn of it at once.
            loop.close(all_fds=True)


class _Application(BokehTornado):  # type: ignore[misc]
    """Serves only requests that name an accepted host, each with a Content-Security-Policy.

    Without the check of Host, another site could reach the page through a name that it resolves to this computer
    (DNS rebinding).
    """

    def __init__(self, view: View, hosts: list[str], parameters: Parameters | None) -> None:
        self._hosts = create_hosts_allowlist(hosts, None)
        patterns = (
            [] if parameters is None else [(r"/parameters", _ParametersPage, {"parameters": parameters})]
        )

        def open_page(document: Any) -> None:
            Page(document, view, document.session_context.request.headers.get(_NONCE, ""))

        super().__init__(
            {"/": Application(FunctionHandler(open_page))},
            extra_websocket_origins=self._hosts,
            extra_patterns=patterns,
            # A closed tab is forgotten soon, so that it costs nothing.
            check_unused_sessions_milliseconds=1000,
            unused_session_lifetime_milliseconds=2000,
        )
        self.add_transform(_SecurityPolicy)

    def find_handler(self, request: HTTPServerRequest, **kwargs: Any) -> Any:
        request.headers[_NONCE] = secrets.token_urlsafe(16)
        if check_allowlist(request.host, self._hosts):
            return super().find_handler(request, **kwargs)
        return self.get_handler_delegate(request, _UnknownHost)


_NONCE = "X-Nonce"
"""Header that hands the nonce of a response to the page; one from the client is replaced."""


class _SecurityPolicy(OutputTransform):  # type: ignore[misc]
    """Adds the Content-Security-Policy to every response.

    Only scripts of this server and inline scripts with the nonce run. Bokeh needs inline styles, and `data:` for its icons.
    """

    def __init__(self, request: HTTPServerRequest) -> None:
        # Some browsers do not count a websocket as 'self'.
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
        return status_code, headers, chunk


class _UnknownHost(RequestHandler):  # type: ignore[misc]
    """Answers requests whose header Host is not accepted."""

    def prepare(self) -> None:
        self.set_status(403)
        self.finish(
            "The viewer does not accept this host name. Add HOST:PORT to the viewer's parameter origins.\n"
        )


class _ParametersPage(RequestHandler):  # type: ignore[misc]
    """The nodes' parameters as a plain table; nothing can be set from here."""

    def initialize(self, parameters: Parameters) -> None:
        self._parameters = parameters

    def get(self) -> None:
        rows: list[str] = []
        for node, values in self._parameters().items():
            rows.append(f"<tr><th colspan=2>{html.escape(node)}</th></tr>")
            rows += [
                f"<tr><td>{html.escape(name)}</td><td>{html.escape(str(value))}</td></tr>"
                for name, value in values.items()
            ]
        self.write(
            '<!DOCTYPE html><html lang="en"><meta charset="utf-8"><title>Parameters</title>'
            '<meta name="viewport" content="width=device-width"><link rel="icon" href="data:,">'
            "<style>body{font:14px/1.4 system-ui,sans-serif;margin:16px}td,th{text-align:left;padding:2px 12px 2px 0;"
            "overflow-wrap:anywhere}</style>"
            "<h1>Parameters</h1><p>As they are now. Set one with <code>ros2 param set NODE NAME VALUE</code>.</p>"
            f"<table>{''.join(rows) or '<tr><td>no node has answered</td></tr>'}</table></html>"
        )


def _hosts(host: str, port: int, more: tuple[str, ...]) -> list[str]:
    """Return the `host:port` that requests may name as Host and as Origin."""
    names = {"localhost", "127.0.0.1"} | ({host} if host not in EVERY else set())
    return [*(f"{name}:{port}" for name in sorted(names)), *more]
