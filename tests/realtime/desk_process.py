"""`rollerrig desk` as a separate process, a client that does what a browser does, and its page."""

import contextlib
import http.client
import json
import os
import re
import signal
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple
from urllib.parse import urlsplit

from bench_process import until

# keys of the WebDriver protocol: control and "a" (then all keys released), and tabulator
SELECT_ALL = "\ue009a\ue000"
TABULATOR = "\ue004"
FREE_PORTS = "modbus.port=0 bus.interface=hub bus.socketcand_port=0"
PATIENCE_S = 60.0


class Served(NamedTuple):
    """A desk that runs: its address with the token, its process, and the file of its messages."""

    address: str
    process: subprocess.Popen
    stderr: Path

    @property
    def port(self):
        return urlsplit(self.address).port

    @property
    def token(self):
        return self.address.partition("token=")[2]


class Answer(NamedTuple):
    """The answer to a request."""

    status: int
    headers: http.client.HTTPMessage
    text: str


@contextlib.contextmanager
def served(folder, *arguments, **environment):
    """Run a desk that follows only benches that it has started, and yield it as `Served`."""
    stderr = folder / "desk.stderr"
    command = [sys.executable, "-m", "rollerrig.realtime.cli", "desk", "--port", "0", "--own"]
    command += ["--folder", str(folder), "--json", *map(str, arguments)]
    # with this variable, NiceGUI would simulate its server
    variables = {**os.environ, **environment}
    variables.pop("PYTEST_CURRENT_TEST", None)
    with open(stderr, "wb") as messages:
        process = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=messages, text=True, env=variables
        )
    try:
        line = process.stdout.readline()
        assert line, stderr.read_text()
        yield Served(json.loads(line)["address"], process, stderr)
    finally:
        process.terminate()
        process.communicate(timeout=PATIENCE_S)
        _kill_programs(folder)


def _kill_programs(folder):
    """Kill the processes in a folder: a bench that a desk has started continues without it."""
    for working_folder in Path("/proc").glob("[0-9]*/cwd"):
        with contextlib.suppress(OSError):
            if working_folder.resolve() == folder.resolve():
                os.kill(int(working_folder.parent.name), signal.SIGKILL)


class Client:
    """Requests addresses of a desk, with the cookie that it has after `enter`."""

    def __init__(self, port, host=""):
        self.port = port
        self.host = host or f"127.0.0.1:{port}"
        self.cookie = ""

    def enter(self, token):
        """Open the page with a token, and keep the cookie."""
        answer = self.get(f"/?token={token}")
        match = re.match(r"[^;]*", answer.headers.get("Set-Cookie", ""))
        self.cookie = match[0]
        return answer

    def get(self, path, **headers):
        """Request a path. `Sec_Fetch_Site` is the header of this name, and so on."""
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=PATIENCE_S)
        with contextlib.closing(connection):
            connection.putrequest("GET", path, skip_host=True)
            connection.putheader("Host", self.host)
            if self.cookie:
                connection.putheader("Cookie", self.cookie)
            for name, value in headers.items():
                connection.putheader(name.replace("_", "-"), value)
            connection.endheaders()
            response = connection.getresponse()
            return Answer(response.status, response.headers, response.read().decode())


def entered(desk):
    """A client that has entered a desk with its token."""
    client = Client(desk.port)
    client.enter(desk.token)
    assert client.cookie
    return client


class Page:
    """The page of the desk in a browser, as an operator uses it."""

    def __init__(self, browser):
        self.browser = browser

    def there(self, path):
        """Return the element of an XPath when it is there."""
        return until(lambda: next(iter(self.browser.find_elements("xpath", path)), None), path)

    def click(self, text, answering=True):
        """Click a button, without the mouse: an earlier message may cover it.

        While the desk is silent the page sends nothing, so this waits until it answers, unless
        `answering` is false.
        """
        if answering:
            until(lambda: not self.is_silent(), "a desk that answers")
        button = self.there(f"//button[not(@disabled)][normalize-space()='{text}']")
        self.browser.execute_script("arguments[0].click()", button)

    def is_silent(self):
        """Return whether the page shows that the desk does not answer."""
        return self.browser.execute_script("return document.body.classList.contains('desk-silent')")

    def put(self, label, text):
        """Put a text into a field."""
        field = self.there(f"//input[@aria-label='{label}']")
        field.send_keys(SELECT_ALL, text, TABULATOR)

    def shows(self, text):
        """Return the element with a text when it is there."""
        return self.there(f"//*[contains(text(), '{text}')]")

    def open_tab(self, name):
        """Open a tab of the page."""
        tab = self.there(f"//div[@role='tab'][.='{name}']")
        self.browser.execute_script("arguments[0].click()", tab)

    def prepare(self, values):
        """Prepare a bench with values such as `adhesion=leaf_film`; its brakes are released."""
        self.put("further values", f"{FREE_PORTS} {values}")
        self.click("Prepare")
        self.shows(": held")
        self.put("brake demand, bar", "0")
        self.click("Set")
        self.shows("demand 0.00 bar")

    def end(self):
        """Stop the run and end it."""
        self.click("Stop")
        self.click("End the run")
        self.shows("its run is under Runs")
