"""`uwb-mitigation view`: show a recording on the viewer's page."""

from __future__ import annotations

import time
import webbrowser
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from uwb_mitigation.commands.support import console, options
from uwb_mitigation.commands.support.bundles import show_models

if TYPE_CHECKING:
    from uwb_mitigation.positioning.track_settings import TrackSettings


@options.with_settings()
def view(
    bag: Annotated[
        Path,
        typer.Argument(
            metavar="BAG",
            help="An MCAP bag or rosbag2 folder with ranges (raw or corrected), or the output of `track`.",
        ),
    ],
    settings: TrackSettings,
    anchors: options.AnchorsOption = None,
    namespace: Annotated[
        str | None,
        typer.Option(
            metavar="NAMESPACE", help="Namespace of the ranges, such as /board1, if BAG has several."
        ),
    ] = None,
    host: Annotated[
        str,
        typer.Option(metavar="ADDRESS", help="Address to serve at; 0.0.0.0 = every address of this machine."),
    ] = "localhost",
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port; 0 = a free one.")] = 5006,
    origins: Annotated[
        list[str] | None,
        typer.Option(metavar="HOST:PORT", help="Further address of the page, for a proxy or a host name."),
    ] = None,
    token: Annotated[
        bool, typer.Option("--token", help="Require a generated token, which is part of the URL.")
    ] = False,
    browser: Annotated[bool, typer.Option("--browser", help="Open the page in the browser.")] = False,
) -> None:
    """Show a recording in the browser: map, ranges, CIRs.

    It serves the page of the node `viewer` with a slider for the time, without ROS, until Ctrl-C.

        uwb-mitigation data simulate --like drive -o flat.mcap

        uwb-mitigation view flat.mcap --height 0 --browser
    """
    from uwb_mitigation.commands.offline.track import displaced_anchor, mitigation, read_config
    from uwb_mitigation.recordings.bag.anchor_markers import recorded_anchors
    from uwb_mitigation.types.anchors import load_anchors
    from uwb_mitigation.viewer.playback import BagPlayer
    from uwb_mitigation.viewer.server import ViewerServer
    from uwb_mitigation.viewer.state import View

    anchor_map = load_anchors(anchors) if anchors is not None else recorded_anchors(bag)
    player = BagPlayer(bag, partial(mitigation, settings), namespace)
    config = None if anchor_map is None else read_config(bag, anchor_map, settings, console.warn)
    if player.corrects:
        console.err.print(f"{bag} contains raw ranges only: they are corrected for display.", style="yellow")
    thread = player.index(config, settings.stamp_offset_s, displaced_anchor)
    shown = View(player.scene, title=bag.resolve().name, player=player)
    with ViewerServer(shown, host, port, tuple(origins or ()), "generate" if token else "") as server:
        if server.warning:
            console.err.print(f"warning: {server.warning} (--token).", style="yellow")
        console.out.print(f"{server.url} shows {bag}; Ctrl-C ends it.", markup=False, soft_wrap=True)
        player.play(True)
        if browser:
            webbrowser.open(server.url)
        thread.join()
        show_models(player.models)
        while True:
            time.sleep(3600.0)
