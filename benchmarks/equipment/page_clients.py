"""Open pages of a viewer without a browser; acknowledge updates, and discard everything else. Does not need ROS."""

from __future__ import annotations

import asyncio
import json
import threading
from concurrent.futures import Future
from urllib.parse import urlsplit

from bokeh.util.token import generate_jwt_token, generate_session_id
from tornado.httpclient import HTTPRequest
from tornado.websocket import WebSocketClientConnection, websocket_connect

_TIMEOUT_S = 120.0


class PageClients:
    """Pages that stay open until the block ends.

    Args:
        url: URL of the viewer.
        count: number of pages.

    Attributes:
        received: number of messages to each page, without the first one of the connection.

    Raises:
        OSError: there is no server at this URL.
    """

    def __init__(self, url: str, count: int) -> None:
        self.received = [0] * count
        self._host = urlsplit(url).netloc
        self._pages: list[WebSocketClientConnection] = []
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, name="page_clients", daemon=True)

    def __enter__(self) -> PageClients:
        self._thread.start()
        try:
            for number in range(len(self.received)):
                opening: Future[None] = asyncio.run_coroutine_threadsafe(self._open(number), self._loop)
                opening.result(_TIMEOUT_S)
        except BaseException:
            self._end()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self._end()

    async def _open(self, number: int) -> None:
        # Connect like the script of Bokeh: the token identifies the session.
        token = generate_jwt_token(generate_session_id())
        request = HTTPRequest(f"ws://{self._host}/ws", headers={"Origin": f"http://{self._host}"})
        page = await websocket_connect(request, subprotocols=["bokeh", token])
        await page.read_message()
        # The document contains the first update, which a page acknowledges too.
        await page.write_message(json.dumps({"msgid": "1", "msgtype": "PULL-DOC-REQ"}))
        await page.write_message("{}")
        await page.write_message("{}")
        self._pages.append(page)
        self._loop.create_task(self._read(page, number))

    async def _read(self, page: WebSocketClientConnection, number: int) -> None:
        controls = ""
        while (message := await page.read_message()) is not None:
            self.received[number] += 1
            if isinstance(message, bytes) or not (message.startswith("{") and "update" in message):
                continue
            content = json.loads(message)
            for model in content.get("doc", {}).get("roots", ()):
                if model.get("attributes", {}).get("name") == "controls":
                    controls = model["id"]
                    await self._acknowledge(page, controls, model["attributes"]["update"][0])
            for event in content.get("events", ()):
                if event.get("attr") == "update":
                    await self._acknowledge(page, controls, event["new"][0])

    async def _acknowledge(self, page: WebSocketClientConnection, controls: str, update: int) -> None:
        event = {"kind": "ModelChanged", "model": {"id": controls}, "attr": "acknowledged", "new": update}
        for part in ({"msgid": "2", "msgtype": "PATCH-DOC"}, {}, {"events": [event]}):
            await page.write_message(json.dumps(part))

    def _end(self) -> None:
        self._loop.call_soon_threadsafe(self._close)
        self._thread.join()
        self._loop.close()

    def _close(self) -> None:
        for page in self._pages:
            page.close()
        # One iteration later, so that the server is notified.
        self._loop.call_later(0.2, self._loop.stop)
