"""`uwb-mitigation view`: show a recording on the viewer's page."""

from __future__ import annotations

import time
import webbrowser
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from uwb_mitigation.commands.support import console, options
from uwb_mitigation.commands.support.bundles import show_models
from uwb_mitigation.commands.support.options import argument, option

if TYPE_CHECKING:
    from uwb_mitigation.positioning.track_settings import TrackSettings


@options.with_settings()
def view(
    bag: Annotated[
        Path,
        argument(
            "BAG", "An MCAP bag or rosbag2 folder with ranges (raw or corrected), or the output of `track`."
        ),
    ],
    settings: TrackSettings,
    anchors: options.AnchorsOption = None,
    namespace: Annotated[
        str | None,
        option("Namespace of the ranges, such as /board1, if BAG has several.", metavar="NAMESPACE"),
    ] = None,
    host: Annotated[
        str, option("Address to serve at; 0.0.0.0 = every address of this machine.", metavar="ADDRESS")
    ] = "localhost",
    port: Annotated[int, option("Port; 0 = a free one.", min=0, max=65535)] = 5006,
    origins: Annotated[
        list[str] | None,
        option("Further address of the page, for a proxy or a host name.", metavar="HOST:PORT"),
    ] = None,
    token: Annotated[bool, option("Require a generated token, which is part of the URL.", "--token")] = False,
    browser: Annotated[bool, option("Open the page in the browser.", "--browser")] = False,
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
