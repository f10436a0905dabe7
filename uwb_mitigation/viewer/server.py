"""Serves the viewer's page over http from a thread of its own, with everything that the page needs: no network."""

from __future__ import annotations

import asyncio
import html
import logging
import queue
import socket
import threading
from collections.abc import Callable, Mapping
from typing import Any

from bokeh.application import Application
from bokeh.application.handlers.function import FunctionHandler
from bokeh.server.server import Server
from tornado.ioloop import IOLoop
from tornado.web import RequestHandler

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
        origins: further `host:port` that a browser may name, for a page behind a proxy or a host name.
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
        # Bokeh wants to know the port beforehand, to tell who may open a websocket.
        port = port or _free_port()
        asyncio.set_event_loop(asyncio.new_event_loop())
        # That a tab was closed while something was on its way to it is nothing to warn of.
        logging.getLogger("bokeh.server.views.ws").setLevel(logging.ERROR)
        loop = IOLoop.current()
        patterns = (
            [] if parameters is None else [(r"/parameters", _ParametersPage, {"parameters": parameters})]
        )

        def open_page(document: Any) -> None:
            Page(document, view)

        try:
            server = Server(
                {"/": Application(FunctionHandler(open_page))},
                io_loop=loop,
                address="" if host in EVERY else host,
                port=port,
                allow_websocket_origin=_origins(host, port, origins),
                extra_patterns=patterns,
                # A closed tab is forgotten soon, so that it costs nothing.
                check_unused_sessions_milliseconds=1000,
                unused_session_lifetime_milliseconds=2000,
            )
        except Exception as error:
            outcome.put(error)
            return
        self._loop = loop
        server.start()
        loop.add_callback(outcome.put, int(server.port))
        try:
            loop.start()
        finally:
            server.unlisten()
            server.stop()
            # Its connections too, so that pages learn of it at once.
            loop.close(all_fds=True)


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


def _origins(host: str, port: int, more: tuple[str, ...]) -> list[str]:
    """Who may open the page's websocket: pages of other sites in the same browser may not."""
    names = {"localhost", "127.0.0.1"} | ({host} if host not in EVERY else set())
    return [*(f"{name}:{port}" for name in sorted(names)), *more]


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("localhost", 0))
        return int(probe.getsockname()[1])
