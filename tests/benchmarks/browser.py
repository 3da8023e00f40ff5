"""A client that does what a browser does with the desk, without drawing anything.

    python tests/benchmarks/browser.py ADDRESS

It exchanges the token in the address for a cookie, loads the page, opens its websocket, prints one
line, and then requests new rows ten times a second until it is killed.
"""

import asyncio
import re
import sys
import time

import httpx
import socketio

# longest time in s to wait for an answer: on a busy machine the desk is slow
ANSWER_WITHIN_S = 60.0
# seconds between two requests for rows, as in desk.js
PERIOD_S = 0.1


async def browse(address: str) -> None:
    """Load the page, open its websocket, print a line, and request rows until killed."""
    page_address, _, token = address.partition("?")
    async with httpx.AsyncClient(base_url=page_address, timeout=ANSWER_WITHIN_S) as client:
        # the answer has the cookie, which the client keeps
        await client.get(f"/?{token}")
        page = (await client.get("/")).text
        client_id = re.search(r"'client_id': '([0-9a-f-]+)'", page)
        assert client_id, page[:200]
        cookies = "; ".join(f"{name}={value}" for name, value in client.cookies.items())
        await _connect(page_address, client_id[1], cookies)
        print("connected", flush=True)

        # what the page has so far: rows of this bench, up to this number of points
        bench = ""
        points = 0
        while True:
            begun_s = time.monotonic()
            answer = await client.get("/desk/rows", params={"bench": bench, "after": points})
            rows = answer.json()
            bench = rows["bench"]
            points = rows["points"]
            spent_s = time.monotonic() - begun_s
            await asyncio.sleep(max(0.0, PERIOD_S - spent_s))


async def _connect(address: str, client_id: str, cookies: str) -> None:
    """Open the websocket of the page, as the script of NiceGUI does in a browser."""
    query = "&".join(
        (
            f"client_id={client_id}",
            "implicit_handshake=true",
            "tab_id=tab",
            "document_id=document",
            "next_message_id=0",
        )
    )
    # nothing reads or closes the websocket: tasks of the client keep it open in the background
    websocket = socketio.AsyncClient()
    await websocket.connect(
        f"{address}?{query}",
        headers={"Cookie": cookies},
        socketio_path="/_nicegui_ws/socket.io",
        transports=["websocket"],
    )


if __name__ == "__main__":
    asyncio.run(browse(sys.argv[1]))
