"""Serves the desk to those who have its token (see `guard`), and reports its address."""

import asyncio
import socket
import tempfile
import webbrowser
from collections.abc import Callable
from pathlib import Path
from typing import Any

from fastapi.responses import FileResponse, PlainTextResponse, Response
from nicegui import app, ui
from nicegui.json import NiceGUIJSONResponse

from rollerrig.configs.errors import ConfigError
from rollerrig.realtime.desk import connections, guard, live, page
from rollerrig.realtime.desk.desk import Desk
from rollerrig.wsp_interface import events
from rollerrig.wsp_interface.bus.hub import beyond_loopback
from rollerrig.wsp_interface.events import Code

_SERVED_SUFFIXES = (".html", ".svg", ".png", ".json", ".xml", ".csv", ".pdf", ".rrd", ".log")
# status codes of HTTP
_NO_CONTENT = 204
_NOT_FOUND = 404
# time between two looks whether the server answers
_LOOK_AGAIN_S = 0.05
# leads the browser of `--open` to the desk
DOORSTEP = '<!doctype html><meta http-equiv="refresh" content="0; url={address}">\n'


def free(host: str, port: int) -> int:
    """Return the port, or any free port if it is 0. Raises ConfigError if it is in use."""
    try:
        with socket.create_server((host, port)) as probe:
            return int(probe.getsockname()[1])
    except (OSError, OverflowError) as error:
        raise ConfigError(
            f"{host}:{port} cannot be opened ({error}); if a desk runs there already, open the "
            "address that it has printed, else give another port with --port"
        ) from None


def routes(desk: Desk) -> None:
    """Register the other addresses: scripts of the page, new rows, and files of reports."""
    for script in page.SCRIPTS:
        app.add_static_file(
            local_file=Path(__file__).with_name(script), url_path=f"/desk/{script}", max_cache_age=0
        )

    @app.get("/desk/alive")
    async def alive() -> Response:
        return Response(status_code=_NO_CONTENT)

    @app.get("/desk/rows")
    def rows(bench: str = "", after: int = 0, whole: int = 0) -> Any:
        return NiceGUIJSONResponse(live.answer(desk, bench, after, bool(whole)))

    @app.get(guard.FILES + "{path:path}")
    def file(path: str) -> Any:
        found = _report(desk.folder.resolve(), path)
        if found is None:
            return PlainTextResponse(f"{path}: no report is there", _NOT_FOUND)
        return FileResponse(found)


def _report(folder: Path, path: str) -> Path | None:
    """Return the file at a path below a folder; None if there is none that may be served."""
    try:
        # a path with `..` or a link must not leave the folder
        found = (folder / path).resolve()
        is_file = found.is_file()
    except (OSError, ValueError):
        return None  # no file can have this name
    may_be_served = found.is_relative_to(folder) and found.suffix in _SERVED_SUFFIXES
    return found if may_be_served and is_file else None


def serve(
    desk: Desk, host: str, port: int, show: bool, on_ready: Callable[[str, str], None]
) -> None:
    """Serve the desk until it is interrupted. `show` opens a browser.

    It calls `on_ready(address, warning)` as soon as the server answers. The address contains the
    token. The warning is empty on loopback. Raises ConfigError if the port cannot be opened.
    """
    port = free(host, port)
    exposed = {
        "server": "THE DESK",
        "host": host,
        "port": port,
        "who": "WHO HAS THE TOKEN OF ITS ADDRESS",
    }
    on_loopback = not beyond_loopback(host)
    warning = "" if on_loopback else events.text(Code.SERVER_EXPOSED, exposed)
    token = guard.new_token()
    address = _address(host, port, token)
    tasks: list[asyncio.Task[None]] = []
    private = tempfile.TemporaryDirectory(prefix="rollerrig-desk-")  # only for this user

    async def report_address() -> None:
        # NiceGUI calls its start-up functions before it listens
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        with socket.socket(family) as probe:
            # `connect_ex` returns 0 when the connection is made
            while probe.connect_ex((host, port)):
                await asyncio.sleep(_LOOK_AGAIN_S)
        on_ready(address, warning)
        if show:
            await asyncio.to_thread(_open_browser, address, Path(private.name))

    def begin() -> None:
        loop = asyncio.get_running_loop()
        tasks.append(loop.create_task(desk.work()))
        tasks.append(loop.create_task(report_address()))

    def on_event(code: Code, /, **fields: Any) -> None:
        desk.alarm("warning", events.text(code, fields))

    routes(desk)
    app.add_middleware(guard.Guard, token=token, on_loopback=on_loopback)
    app.on_startup(begin)
    app.on_shutdown(desk.close)
    # here, because a desk that is terminated does not return from `run`
    app.on_shutdown(private.cleanup)
    ui.run(
        lambda: page.build(desk),
        host=host,
        port=port,
        title="rollerrig desk",
        favicon="🚆",
        dark=None,  # as the system
        language="en-US",
        reload=False,
        show=False,
        show_welcome_message=False,
        reconnect_timeout=10.0,
        http=connections.protocol(on_event),
        backlog=connections.BACKLOG,
    )


def _open_browser(address: str, private: Path) -> None:
    """Open a browser at the address with the token.

    The browser gets a file that leads it there, because other users can read the command line of a
    process. The file is in a private folder.
    """
    doorstep = private / "open.html"
    doorstep.write_text(DOORSTEP.format(address=address), encoding="utf-8")
    webbrowser.open(doorstep.as_uri())


def _address(host: str, port: int, token: str) -> str:
    """Return the address of the page with its token."""
    name = f"[{host}]" if ":" in host else host
    return f"http://{name}:{port}/?token={token}"
