"""Serves the desk: on loopback to this machine alone, elsewhere to who has its token.

Requests that come from a page of another site are refused, and on loopback those that ask for another name: a page
of a stranger must not reach the bench through the browser of its operator.
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

PORT, COOKIE = 8530, "rollerrig-desk"
_SERVED = (".html", ".svg", ".png", ".json", ".xml", ".csv", ".pdf", ".rrd", ".log")
_OWN_NAMES = ("127.0.0.1", "localhost", "::1")
Message = MutableMapping[str, Any]


class Guard:
    """Lets requests through that have the token (where there is one), and come from no other site."""

    def __init__(self, app: Any, token: str) -> None:
        self.to, self.token = app, token

    async def __call__(
        self,
        scope: Message,
        receive: Callable[[], Awaitable[Message]],
        send: Callable[[Message], Awaitable[None]],
    ) -> None:
        """One request."""
        if scope["type"] not in ("http", "websocket"):
            await self.to(scope, receive, send)
            return
        heads = {
            name.decode("latin-1"): value.decode("latin-1") for name, value in scope["headers"]
        }
        asked = parse_qs(scope.get("query_string", b"").decode("latin-1")).get("token", [""])[0]
        if why := refused(heads, asked, self.token):
            if scope["type"] == "http":
                await PlainTextResponse(f"rollerrig desk: {why}", 403)(scope, receive, send)
            else:
                await send({"type": "websocket.close", "code": 1008})
            return

        async def with_cookie(message: Message) -> None:
            if message["type"] == "http.response.start" and asked and self.token:
                cookie = f"{COOKIE}={self.token}; HttpOnly; SameSite=Strict; Path=/"
                message["headers"] = [*message.get("headers", []), (b"set-cookie", cookie.encode())]
            await send(message)

        await self.to(scope, receive, with_cookie)


def refused(heads: MutableMapping[str, str], asked: str, token: str) -> str:
    """Why a request with these headers and this token in its address is refused; empty where it is not."""
    host = heads.get("host", "")
    if (origin := heads.get("origin")) and urlsplit(origin).netloc != host:
        return f"a page of {origin} has no business here"
    if not token:
        name = urlsplit(f"//{host}").hostname
        return "" if name in _OWN_NAMES else f"it answers to {', '.join(_OWN_NAMES)}, not to {name}"
    cookie = SimpleCookie(heads.get("cookie", ""))
    shown = asked or (cookie[COOKIE].value if COOKIE in cookie else "")
    if hmac.compare_digest(shown.encode(), token.encode()):
        return ""
    return "the token is missing or wrong; open the address that 'rollerrig desk' has printed"


def free(host: str, port: int) -> int:
    """The port, or with 0 one that is free. Raises ConfigError where it is taken."""
    try:
        with socket.create_server((host, port)) as probe:
            return int(probe.getsockname()[1])
    except (OSError, OverflowError) as error:
        raise ConfigError(
            f"{host}:{port} cannot be opened ({error}); if a desk runs there already, open "
            f"http://{host}:{port} in a browser, else give another with --port"
        ) from None


def routes(desk: Desk) -> None:
    """What is served beside the page: its drawing program, rows, and reports below the folder."""
    app.add_static_file(
        local_file=Path(__file__).with_name("desk.js"), url_path="/desk/desk.js", max_cache_age=0
    )

    @app.get("/desk/rows")
    def rows(bench: str = "", after: int = 0, whole: int = 0) -> Any:
        return NiceGUIJSONResponse(live.answer(desk, bench, after, bool(whole)))

    @app.get("/file/{path:path}")
    def file(path: str) -> Any:
        found = (desk.folder / path).resolve()
        if (
            found.is_relative_to(desk.folder.resolve())
            and found.suffix in _SERVED
            and found.is_file()
        ):
            return FileResponse(found)
        return PlainTextResponse(f"{path}: no report is there", 404)


def serve(desk: Desk, host: str, port: int, show: bool, say: Callable[[str, str], None]) -> None:
    """Serve until interrupted. `say(address, warning)` is called once it answers. Raises ConfigError."""
    port = free(host, port)
    exposed = {
        "server": "THE DESK",
        "host": host,
        "port": port,
        "who": "WHO HAS THE TOKEN OF ITS ADDRESS",
    }
    warning = events.text(Code.SERVER_EXPOSED, exposed) if beyond_loopback(host) else ""
    token = secrets.token_urlsafe(24) if warning else ""
    address = (
        f"http://{f'[{host}]' if ':' in host else host}:{port}/{f'?token={token}' if token else ''}"
    )
    working: list[asyncio.Task[None]] = []

    async def tell() -> None:
        """The address, once it answers: what is called at the start is called before."""
        with socket.socket() if ":" not in host else socket.socket(socket.AF_INET6) as probe:
            while probe.connect_ex((host, port)):
                await asyncio.sleep(0.05)
        say(address, warning)

    def begin() -> None:
        working.extend(asyncio.get_running_loop().create_task(one) for one in (desk.work(), tell()))

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
