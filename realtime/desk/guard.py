"""Decides which requests the desk answers, and how a browser may use the answers.

A request needs the token of the desk, also on loopback, because other users of a machine and pages
of other sites reach its loopback ports too. The token is in the address that `rollerrig desk`
prints. The first request with it gets a cookie and is sent on to an address without the token. The
cookie is valid only for the host and port of that request.

A browser sends a cookie to every port of a host. So the cookie does not contain the token, and the
guard also refuses requests that a page of another port or site has caused.
"""

import hashlib
import hmac
import re
import secrets
from collections.abc import Awaitable, Callable, MutableMapping
from typing import Any, NamedTuple

from fastapi.requests import HTTPConnection
from fastapi.responses import HTMLResponse, PlainTextResponse, Response
from nicegui import Client

from rollerrig.realtime.desk import connections
from rollerrig.wsp_interface.bus.hub import beyond_loopback

FILES = "/file/"  # files of the folder of runs are below this path
# pages that may be open at the same time, over all browsers; each takes about a megabyte
MOST_PAGES = 32
# paths below which the desk and NiceGUI have addresses; a path elsewhere does not exist
_PAGE = "/"
_BELOW = ("/desk/", FILES, "/_nicegui/", "/_nicegui_ws/", "/favicon.ico")
# a host name or address, and a port
_HOST = re.compile(r"(?P<name>\[[0-9a-f:.]+\]|[a-z0-9._-]+)(?::(?P<port>\d{1,5}))?", re.IGNORECASE)
_CONTROL_CHARACTER = re.compile(r"[\x00-\x1f\x7f]")
# values of Sec-Fetch-Site that no other page causes; "none" is an address that the user has typed,
# and browsers without this header leave it empty
_NO_OTHER_PAGE = ("", "same-origin", "none")
# status codes of HTTP
_BAD_REQUEST = 400
_FORBIDDEN = 403
_NOT_FOUND = 404
_UNAVAILABLE = 503
# close code of a WebSocket, RFC 6455
_POLICY_VIOLATION = 1008
_TOKEN_BYTES = 24  # of random data, which cannot be guessed
_DEFAULT_PORT = "80"  # of HTTP
_TOKEN_NEEDED = (
    "the token is missing or wrong; copy the address that 'rollerrig desk' has printed into the "
    "address bar"
)
# a browser follows `refresh` as a step of this page: the address with the token leaves the history,
# and the cookie is sent even if another program or page has opened the address
_ENTRANCE = (
    '<!doctype html><title>rollerrig desk</title><meta http-equiv="refresh" content="0; url=/">'
    '<a href="/">rollerrig desk</a>'
)
# rules of a browser for each answer
_RULES = {
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
}
# NiceGUI writes scripts into its page and evaluates code that it sends to it
_PAGE_POLICY = (
    "default-src 'self'; script-src 'self' 'unsafe-inline' 'unsafe-eval'; "
    "style-src 'self' 'unsafe-inline'; img-src 'self' data:; font-src 'self' data:; "
    "connect-src 'self' ws://{host} wss://{host}; object-src 'none'; base-uri 'none'; "
    "form-action 'none'; frame-ancestors 'none'"
)
# a report needs styles, pictures within it, and links to other files; a sandbox runs no script
_FILE_POLICY = (
    "sandbox allow-same-origin allow-downloads; default-src 'none'; style-src 'unsafe-inline'; "
    "img-src data:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
# a message of ASGI, and the scope of a request
Message = MutableMapping[str, Any]


class Refusal(NamedTuple):
    """Why a request is refused: the status code of HTTP, and a sentence."""

    status: int
    reason: str


class Host(NamedTuple):
    """The host that a request names: a name in lower case, and a port."""

    name: str
    port: str

    @property
    def text(self) -> str:
        """Name and port as one text."""
        return f"{self.name}:{self.port}"


class Guard:
    """ASGI middleware that passes on the requests that are allowed.

    `on_loopback`: the desk listens on loopback only, so that a request must name loopback as its
    host.
    """

    def __init__(self, app: Any, token: str, on_loopback: bool) -> None:
        self.app = app
        self.token = token
        self.on_loopback = on_loopback

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

        request = HTTPConnection(scope)
        host = host_of(request)
        rules = _rules(request, host)

        async def send_with_rules(message: Message) -> None:
            if message["type"] == "http.response.start":
                message["headers"] = [*message.get("headers", []), *rules]
            await send(message)

        refusal = refused(request, host, self.token, self.on_loopback)
        if refusal is None:
            connections.note_allowed(scope)
        if refusal is None and host is not None and _enters(request):
            response: Response = HTMLResponse(_ENTRANCE, headers={"Cache-Control": "no-store"})
            response.headers["Set-Cookie"] = (
                f"{cookie_name(host)}={cookie_value(host, self.token)}; HttpOnly; "
                "SameSite=Strict; Path=/"
            )
            await response(scope, receive, send_with_rules)
        elif refusal is None:
            await self.app(scope, receive, send_with_rules)
        elif scope["type"] == "http":
            response = PlainTextResponse(f"rollerrig desk: {refusal.reason}", refusal.status)
            await response(scope, receive, send_with_rules)
        else:
            await send({"type": "websocket.close", "code": _POLICY_VIOLATION})


def new_token() -> str:
    """Return a token that cannot be guessed."""
    return secrets.token_urlsafe(_TOKEN_BYTES)


def host_of(request: HTTPConnection) -> Host | None:
    """Return the host that a request names; None if it names none, several, or a malformed one."""
    given = request.headers.getlist("host")
    if len(given) != 1:
        return None
    match = _HOST.fullmatch(given[0])
    if match is None:
        return None
    return Host(match["name"].lower(), match["port"] or _DEFAULT_PORT)


def refused(
    request: HTTPConnection, host: Host | None, token: str, on_loopback: bool
) -> Refusal | None:
    """Return why a request is refused; None if it is allowed.

    `host` is the host that the request names, and `token` the token of the desk.
    """
    if host is None:
        return Refusal(_BAD_REQUEST, "the header Host is not a host name with an optional port")
    if _CONTROL_CHARACTER.search(request.scope["path"]):
        return Refusal(_BAD_REQUEST, "the address contains a control character")
    if on_loopback and beyond_loopback(host.name.strip("[]")):
        reason = f"this server answers to localhost and 127.0.0.1, not to {host.name}"
        return Refusal(_FORBIDDEN, reason)

    origin = request.headers.get("origin")
    given_host = request.headers["host"]
    if origin not in (None, f"http://{given_host}", f"https://{given_host}"):
        return Refusal(_FORBIDDEN, f"requests from a page of {origin} are not allowed")

    if _enters(request):
        if _same(request.query_params["token"], token):
            return None
        return Refusal(_FORBIDDEN, _TOKEN_NEEDED)
    if request.headers.get("sec-fetch-site", "") not in _NO_OTHER_PAGE:
        return Refusal(_FORBIDDEN, "requests that another page has caused are not allowed")
    given = request.cookies.get(cookie_name(host), "")
    if not _same(given, cookie_value(host, token)):
        return Refusal(_FORBIDDEN, _TOKEN_NEEDED)

    path = request.scope["path"]
    if path != _PAGE and not path.startswith(_BELOW):
        return Refusal(_NOT_FOUND, f"{path}: there is nothing at this address")
    if path == _PAGE and len(Client.instances) >= MOST_PAGES:
        reason = f"{MOST_PAGES} pages are open already; close some, and try again in a minute"
        return Refusal(_UNAVAILABLE, reason)
    return None


def cookie_name(host: Host) -> str:
    """Return the name of the cookie: desks on several ports of a host have different ones."""
    return f"rollerrig-desk-{host.port}"


def cookie_value(host: Host, token: str) -> str:
    """Return the value of the cookie, which is valid for this host and port only."""
    return hmac.new(token.encode(), host.text.encode(), hashlib.sha256).hexdigest()


def _enters(request: HTTPConnection) -> bool:
    """Whether a request brings a token in its address, to get a cookie."""
    is_page = request.scope["type"] == "http" and request.scope["path"] == _PAGE
    return is_page and "token" in request.query_params


def _same(given: str, right: str) -> bool:
    """Compare two texts in a time that does not depend on what is equal."""
    return hmac.compare_digest(given.encode(errors="replace"), right.encode())


def _rules(request: HTTPConnection, host: Host | None) -> list[tuple[bytes, bytes]]:
    """Return the headers that tell a browser how it may use the answer to a request."""
    policy = _FILE_POLICY
    is_file = request.scope["path"].startswith(FILES)
    if host is not None and not is_file:
        policy = _PAGE_POLICY.format(host=request.headers["host"])
    rules = {**_RULES, "Content-Security-Policy": policy}
    return [(name.lower().encode(), value.encode()) for name, value in rules.items()]
