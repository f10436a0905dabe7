"""`uwb-mitigation view`: show a recording on the viewer's page."""

from __future__ import annotations

import time
import webbrowser
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from uwb_mitigation.commands import console
from uwb_mitigation.commands.bundles import ModelOption, bundle_for

if TYPE_CHECKING:
    from uwb_mitigation.mitigation import Backend


def view(
    bag: Annotated[
        Path,
        typer.Argument(
            metavar="BAG",
            help="An MCAP bag or rosbag2 folder with ranges (raw or corrected), or the output of `track`.",
        ),
    ],
    anchors: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Anchors file. Default: X.anchors.yaml next to BAG, else the markers in BAG.",
        ),
    ] = None,
    model: ModelOption = None,
    namespace: Annotated[
        str | None, typer.Option(help="Namespace of the ranges, such as /board1, if BAG has several.")
    ] = None,
    host: Annotated[
        str, typer.Option(help="Address to serve at; 0.0.0.0 = every address of this machine.")
    ] = "localhost",
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port; 0 = a free one.")] = 5006,
    origins: Annotated[
        list[str] | None,
        typer.Option(metavar="HOST:PORT", help="Further address of the page, for a proxy or a host name."),
    ] = None,
    browser: Annotated[bool, typer.Option("--browser", help="Open the page in the browser.")] = False,
) -> None:
    """Show a recording in the browser: map, ranges, CIRs.

    It serves the page of the node `viewer` with a slider for the time, without ROS. It plays in real time until
    Ctrl-C.

        uwb-mitigation data simulate --like drive -o flat.mcap

        uwb-mitigation view flat.mcap --browser
    """
    from threading import Lock

    from uwb_mitigation.sources.site import anchors_file, load_anchors
    from uwb_mitigation.viewer.feed import Feed
    from uwb_mitigation.viewer.page import View
    from uwb_mitigation.viewer.playback import BagPlayer
    from uwb_mitigation.viewer.scene import Scene
    from uwb_mitigation.viewer.server import ViewerServer

    scene, lock = Scene(), Lock()
    feed = Feed(scene, lock)
    player = BagPlayer(bag, feed, lambda: _backend(model, bag), namespace)
    own = anchors_file(bag)
    if anchors is not None or own.is_file():
        feed.anchors(load_anchors(anchors or own))
    if player.corrects:
        console.err.print("The bag contains raw ranges only: they are corrected for display.", style="yellow")
    shown = View(scene, lock, title=bag.resolve().name, player=player, missing=player.missing)
    with ViewerServer(shown, host, port, tuple(origins or ())) as server:
        console.out.print(f"{server.url} shows {bag}; Ctrl-C ends it.", markup=False, soft_wrap=True)
        player.play(True)
        if browser:
            webbrowser.open(server.url)
        while True:
            time.sleep(3600.0)


def _backend(model: Path | None, bag: Path) -> Backend:
    from uwb_mitigation.mitigation import Mitigation

    return Mitigation(bundle_for(model, bag))
