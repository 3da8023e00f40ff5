"""Serves the desk.

On loopback, it serves every program of this machine. On any other address, a request needs the
token of the desk.

The server refuses requests that come from a page of another site. On loopback it also refuses
requests for another host name. Otherwise a foreign web page could reach the bench through the
browser of the operator.
"""

import asyncio
import hmac
import secrets
import socket
from collections.abc import Awaitable, Callable, MutableMapping
from http.cookies import SimpleCookie
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, urlsplit

from fastapi.responses import FileResponse, PlainTextResponse
from nicegui import app, ui
from nicegui.json import NiceGUIJSONResponse

from rollerrig.configs.errors import ConfigError
from rollerrig.realtime.desk import live, page
from rollerrig.realtime.desk.desk import Desk
from rollerrig.wsp_interface import events
from rollerrig.wsp_interface.bus.hub import beyond_loopback
from rollerrig.wsp_interface.events import Code

PORT = 8530
COOKIE = "rollerrig-desk"
_SERVED_SUFFIXES = (".html", ".svg", ".png", ".json", ".xml", ".csv", ".pdf", ".rrd", ".log")
_LOOPBACK_NAMES = ("127.0.0.1", "localhost", "::1")
# status codes of HTTP
_FORBIDDEN = 403
_NOT_FOUND = 404
# close code of a WebSocket, RFC 6455
_POLICY_VIOLATION = 1008
# of an address; 24 bytes of random data cannot be guessed
_TOKEN_BYTES = 24
# time between two looks whether the server answers
_LOOK_AGAIN_S = 0.05
# a message of ASGI, and the scope of a request
Message = MutableMapping[str, Any]


class Guard:
    """ASGI middleware that passes on only requests with the token that no other site has caused.

    An empty token means that requests need none.
    """

    def __init__(self, app: Any, token: str) -> None:
        self.app = app
        self.token = token

    async def __call__(
        self,
        scope: Message,
        receive: Callable[[], Awaitable[Message]],
        send: Callable[[Message], Awaitable[None]],
    ) -> None:
        """Handle one request."""
        if scope["type"] not in ("http", "websocket"):
            await self.app(scope, receive, send)
            return

        headers = {
            name.decode("latin-1"): value.decode("latin-1") for name, value in scope["headers"]
        }
        query = parse_qs(scope.get("query_string", b"").decode("latin-1"))
        token_in_address = query.get("token", [""])[0]
        reason = refused(headers, token_in_address, self.token)
        if reason and scope["type"] == "http":
            response = PlainTextResponse(f"rollerrig desk: {reason}", _FORBIDDEN)
            await response(scope, receive, send)
            return
        if reason:
            await send({"type": "websocket.close", "code": _POLICY_VIOLATION})
            return

        async def send_with_cookie(message: Message) -> None:
            # only the first request has the token in its address; later ones have the cookie
            begins_response = message["type"] == "http.response.start"
            if begins_response and token_in_address and self.token:
                cookie = f"{COOKIE}={self.token}; HttpOnly; SameSite=Strict; Path=/"
                message["headers"] = [*message.get("headers", []), (b"set-cookie", cookie.encode())]
            await send(message)

        await self.app(scope, receive, send_with_cookie)


def refused(headers: MutableMapping[str, str], token_in_address: str, token: str) -> str:
    """Return why a request is refused; empty if it is allowed.

    `token` is the correct token, or empty if requests need none.
    """
    host = headers.get("host", "")
    origin = headers.get("origin")
    if origin and urlsplit(origin).netloc != host:
        return f"requests from a page of {origin} are not allowed"

    if not token:
        name = urlsplit(f"//{host}").hostname
        if name in _LOOPBACK_NAMES:
            return ""
        return f"this server answers to {', '.join(_LOOPBACK_NAMES)}, not to {name}"

    cookies = SimpleCookie(headers.get("cookie", ""))
    given = token_in_address
    if not given and COOKIE in cookies:
        given = cookies[COOKIE].value
    if hmac.compare_digest(given.encode(), token.encode()):
        return ""
    return "the token is missing or wrong; open the address that 'rollerrig desk' has printed"


def free(host: str, port: int) -> int:
    """Return the port, or any free port if it is 0. Raises ConfigError if it is in use."""
    try:
        with socket.create_server((host, port)) as probe:
            return int(probe.getsockname()[1])
    except (OSError, OverflowError) as error:
        raise ConfigError(
            f"{host}:{port} cannot be opened ({error}); if a desk runs there already, open "
            f"http://{host}:{port} in a browser, else give another port with --port"
        ) from None


def routes(desk: Desk) -> None:
    """Register the other addresses: the script of the page, new rows, and files of reports."""
    app.add_static_file(
        local_file=Path(__file__).with_name("desk.js"), url_path="/desk/desk.js", max_cache_age=0
    )

    @app.get("/desk/rows")
    def rows(bench: str = "", after: int = 0, whole: int = 0) -> Any:
        return NiceGUIJSONResponse(live.answer(desk, bench, after, bool(whole)))

    @app.get("/file/{path:path}")
    def file(path: str) -> Any:
        # a path with `..` must not leave the folder of runs
        folder = desk.folder.resolve()
        found = (folder / path).resolve()
        inside = found.is_relative_to(folder)
        if inside and found.suffix in _SERVED_SUFFIXES and found.is_file():
            return FileResponse(found)
        return PlainTextResponse(f"{path}: no report is there", _NOT_FOUND)


def serve(
    desk: Desk, host: str, port: int, show: bool, on_ready: Callable[[str, str], None]
) -> None:
    """Serve the desk until it is interrupted. `show` opens a browser.

    It calls `on_ready(address, warning)` as soon as the server answers. The warning is empty on
    loopback. Raises ConfigError if the port cannot be opened.
    """
    port = free(host, port)
    exposed = {
        "server": "THE DESK",
        "host": host,
        "port": port,
        "who": "WHO HAS THE TOKEN OF ITS ADDRESS",
    }
    warning = ""
    token = ""
    if beyond_loopback(host):
        warning = events.text(Code.SERVER_EXPOSED, exposed)
        token = secrets.token_urlsafe(_TOKEN_BYTES)
    address = _address(host, port, token)
    tasks: list[asyncio.Task[None]] = []

    async def report_address() -> None:
        # NiceGUI calls its start-up functions before it listens
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        with socket.socket(family) as probe:
            # `connect_ex` returns 0 when the connection is made
            while probe.connect_ex((host, port)):
                await asyncio.sleep(_LOOK_AGAIN_S)
        on_ready(address, warning)

    def begin() -> None:
        loop = asyncio.get_running_loop()
        tasks.append(loop.create_task(desk.work()))
        tasks.append(loop.create_task(report_address()))

    routes(desk)
    app.add_middleware(Guard, token=token)
    app.on_startup(begin)
    app.on_shutdown(desk.close)
    ui.run(
        lambda: page.build(desk),
        host=host,
        port=port,
        title="rollerrig desk",
        favicon="🚆",
        dark=True,
        reload=False,
        show=show,
        show_welcome_message=False,
        reconnect_timeout=10.0,
    )


def _address(host: str, port: int, token: str) -> str:
    """Return the address of the page, with its token if there is one."""
    name = f"[{host}]" if ":" in host else host
    query = f"?token={token}" if token else ""
    return f"http://{name}:{port}/{query}"
