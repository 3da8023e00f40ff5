"""The desk answers only to those who have its token, and a browser may not misuse its answers."""

import contextlib
import itertools
import multiprocessing
import os
import resource
import socket
import time
from pathlib import Path

import program
import pytest
from bench_process import until
from chromium import browsing
from desk_process import PATIENCE_S, Client, entered, served

pytest.importorskip("nicegui", reason="the desk needs nicegui")

from rollerrig.realtime.desk import connections, guard, page, server
from rollerrig.wsp_interface.places import PLACES

NOBODY = 65534  # the user without rights of Linux
WEBSOCKET = "/_nicegui_ws/socket.io/?EIO=4&transport=polling"
# a script that acts as soon as a browser runs it
ACTIVE_REPORT = """<!doctype html><title>report</title><a id="next" href="next.html">next</a>
<script>document.title = 'the script has run'; fetch('/desk/rows')</script>
"""
PAGES_MB = 20.0  # 300 pages take more than ten times as much


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """The folder of a desk, with reports and with a file that is no report."""
    folder = tmp_path_factory.mktemp("desk")
    (folder / "reports").mkdir()
    (folder / "reports/report.html").write_text(ACTIVE_REPORT)
    (folder / "reports/next.html").write_text("<!doctype html><title>the next report</title>")
    (folder / "reports/picture.svg").write_text("<svg xmlns='http://www.w3.org/2000/svg'/>")
    (folder / "secret.toml").write_text("no report")
    return folder


@pytest.fixture(scope="module")
def desk(folder):
    """A desk on loopback, for all tests that do not end it."""
    with served(folder) as desk:
        yield desk


# -- the token


@pytest.mark.parametrize(
    "path", ["/", "/desk/rows", "/desk/desk.js", "/file/reports/report.html", WEBSOCKET]
)
def test_nothing_of_a_desk_on_loopback_is_served_without_its_token(desk, path):
    answer = Client(desk.port).get(path)
    assert answer.status == 403
    assert "copy the address that 'rollerrig desk' has printed" in answer.text


def test_a_wrong_token_is_refused_and_gives_no_cookie(desk):
    client = Client(desk.port)
    for wrong in ("", desk.token[:-1], desk.token + "a", "%ff", "%00"):
        answer = client.enter(wrong)
        assert answer.status == 403
        assert not client.cookie


def test_the_token_is_exchanged_for_a_cookie_and_leaves_the_address(desk):
    client = Client(desk.port)
    answer = client.enter(desk.token)
    assert len(desk.token) >= 32
    assert answer.status == 200
    assert "HttpOnly; SameSite=Strict" in answer.headers["Set-Cookie"]
    assert 'http-equiv="refresh" content="0; url=/"' in answer.text
    assert answer.headers["Referrer-Policy"] == "no-referrer"
    assert desk.token not in answer.text + client.cookie

    assert page.NO_SAFETY in client.get("/").text
    assert client.get("/desk/rows").status == 200
    assert client.get(WEBSOCKET).status == 200


def test_the_cookie_is_valid_for_its_host_and_port_only(desk):
    client = entered(desk)
    name, value = client.cookie.split("=")
    assert name.endswith(f"-{desk.port}")
    for host in (f"localhost:{desk.port}", "127.0.0.1:9999", "127.0.0.1"):
        elsewhere = Client(desk.port, host)
        elsewhere.cookie = "; ".join(
            f"{guard.cookie_name(guard.Host('any', port))}={value}"
            for port in ("80", "9999", desk.port)
        )
        assert elsewhere.get("/desk/rows").status == 403


def ask_as(user, port, paths, statuses):
    """Become a user, request paths, and send the statuses of the answers."""
    os.setgroups([])
    os.setgid(user)
    os.setuid(user)
    client = Client(port)
    for path in paths:
        statuses.send(client.get(path).status)
    # what this user can see of the desk
    seen = []
    for file in Path("/proc").glob("[0-9]*/cmdline"):
        # a process may end in the meantime
        with contextlib.suppress(OSError):
            seen.append(file.read_text(errors="replace"))
    statuses.send("\n".join(seen))


def test_another_user_of_the_machine_cannot_reach_a_desk_nor_see_its_token(desk):
    if os.geteuid() != 0:
        pytest.skip("only root can act as another user")
    paths = ("/", "/desk/rows", WEBSOCKET)
    here, there = multiprocessing.Pipe()
    other = multiprocessing.get_context("fork").Process(
        target=ask_as, args=(NOBODY, desk.port, paths, there)
    )
    other.start()
    there.close()
    assert [here.recv() for _ in paths] == [403] * len(paths)
    command_lines = here.recv()
    assert "rollerrig.realtime.cli" in command_lines
    assert desk.token not in command_lines
    other.join()


def test_the_browser_of_open_gets_the_token_by_a_private_file(tmp_path):
    seen = tmp_path / "seen"
    browser = tmp_path / "browser.sh"
    browser.write_text(f'#!/bin/sh\necho "$1" > {seen}.new; mv {seen}.new {seen}\n')
    browser.chmod(0o755)
    with served(tmp_path, "--open", BROWSER=f"{browser} %s") as desk:
        until(seen.exists, "the browser")
        opened = seen.read_text().strip()
        assert desk.token not in opened
        doorstep = Path(opened.removeprefix("file://"))
        assert desk.address in doorstep.read_text()
        assert doorstep.parent.stat().st_mode & 0o077 == 0
    assert not doorstep.exists()


@pytest.fixture(scope="module")
def desk_beyond_loopback(tmp_path_factory):
    """A desk that listens on all addresses of the machine, and of which all pages may be opened."""
    with served(tmp_path_factory.mktemp("beyond"), "--host", "0.0.0.0") as desk:
        yield desk


def test_beyond_loopback_the_desk_warns_loudly_and_requires_its_token_too(desk_beyond_loopback):
    desk = desk_beyond_loopback
    client = Client(desk.port, f"rig.example:{desk.port}")
    assert client.get("/").status == 403
    assert client.enter(desk.token).status == 200
    assert client.get("/desk/rows").status == 200
    assert "THE DESK LISTENS BEYOND THIS MACHINE" in desk.stderr.read_text()


@pytest.mark.nightly
def test_a_second_desk_on_a_port_is_refused_with_a_message(desk):
    second = program.rollerrig("desk", "--port", desk.port, timeout_s=120)
    assert second.status == 2
    assert "if a desk runs there already, open the address that it has printed" in second.messages
    assert "Traceback" not in second.messages


# -- other sites, and malformed requests


@pytest.mark.parametrize(
    "headers",
    [
        {"Origin": "http://elsewhere.example"},
        {"Origin": "null"},
        {"Origin": "http://["},
        {"Origin": "http://127.0.0.1:9999"},
        {"Sec_Fetch_Site": "cross-site"},
        {"Sec_Fetch_Site": "same-site"},
    ],
)
def test_a_page_of_another_site_or_port_cannot_use_the_cookie_of_a_browser(desk, headers):
    client = entered(desk)
    assert client.get("/", **headers).status == 403
    assert client.get("/desk/rows", **headers).status == 403
    assert client.get("/desk/rows", Origin=f"http://{client.host}").status == 200


@pytest.mark.parametrize(
    ("host", "status"),
    [
        ("elsewhere.example", 403),
        ("127.0.0.1.elsewhere.example", 403),
        ("10.0.0.1:8530", 403),
        ("[::1", 400),
        ("[", 400),
        ("::1", 400),
        ("a b", 400),
        ("127.0.0.1:port", 400),
        ("user@127.0.0.1", 400),
        ("", 400),
        ("\xff", 400),
    ],
)
def test_a_request_for_another_or_no_host_is_refused(desk, host, status):
    client = entered(desk)
    client.host = host
    assert client.get(f"/?token={desk.token}").status == status


def test_a_request_with_two_hosts_is_refused(desk):
    with socket.create_connection(("127.0.0.1", desk.port), timeout=60.0) as connection:
        host = f"Host: 127.0.0.1:{desk.port}\r\n"
        request = f"GET /?token={desk.token} HTTP/1.1\r\n{host}{host}\r\n"
        connection.sendall(request.encode())
        assert connection.recv(12) == b"HTTP/1.1 400"


@pytest.mark.parametrize(
    ("path", "status"),
    [
        ("/file/%00", 400),
        ("/file/reports/report.html%00.html", 400),
        ("/%00", 400),
        ("/desk/desk.js%00", 400),
        ("/_nicegui/%0a", 400),
        ("/file/" + "a" * 5000 + ".html", 404),
        ("/file/" + "a/" * 5000 + "a.html", 404),
        ("/file/%ff.html", 404),
        ("/file/secret.toml", 404),
        ("/file/reports", 404),
        ("/file/%2e%2e/%2e%2e/etc/hostname", 404),
        ("/file//etc/hostname", 404),
        ("/nothing", 404),
        ("/desk/rows?after=one", 422),
    ],
)
def test_an_address_that_does_not_exist_is_answered_without_a_traceback(desk, path, status):
    assert entered(desk).get(path).status == status
    assert "Traceback" not in desk.stderr.read_text()


# -- memory


def memory_MB(process):
    """The memory of a process in MB."""
    resident_pages = int(Path(f"/proc/{process.pid}/statm").read_text().split()[1])
    return resident_pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def test_requests_of_other_sites_and_for_unknown_addresses_take_no_memory(desk):
    client = entered(desk)
    for path in ("/", "/desk/rows", "/nothing"):
        client.get(path)
    before_MB = memory_MB(desk.process)
    for number in range(100):
        client.get("/", Sec_Fetch_Site="cross-site")
        client.get(f"/unknown-{number}")
        Client(desk.port).get("/")
    assert memory_MB(desk.process) - before_MB < PAGES_MB


def test_the_number_of_open_pages_is_limited(desk_beyond_loopback):
    client = entered(desk_beyond_loopback)
    statuses = [client.get("/").status for _ in range(guard.MOST_PAGES + 3)]
    assert client.get("/desk/rows").status == 200  # a page that is open continues
    allowed = list(itertools.takewhile(lambda status: status == 200, statuses))
    assert guard.MOST_PAGES - 3 <= len(allowed) <= guard.MOST_PAGES
    assert set(statuses[len(allowed) :]) == {503}


# -- connections without requests


def descriptors(process):
    return len(os.listdir(f"/proc/{process.pid}/fd"))


def test_idle_connections_of_another_user_do_not_keep_the_owner_out(folder):
    with served(folder) as desk, contextlib.ExitStack() as others:
        resource.prlimit(desk.process.pid, resource.RLIMIT_NOFILE, (300, 300))
        before = descriptors(desk.process)
        client = entered(desk)
        # half of them send a part of a request, again and again
        idle = []
        for number in range(600):
            connection = others.enter_context(socket.create_connection(("127.0.0.1", desk.port)))
            idle.append(connection)
            for slow in idle[-20:]:
                # the desk may have closed it
                with contextlib.suppress(OSError):
                    slow.send(b"GET / HTTP/1.1\r\n" if slow is connection else b"a: b\r\n")
            if number % 60 == 0:
                assert client.get("/desk/rows").status == 200
        assert entered(desk).get("/desk/rows").status == 200
        assert descriptors(desk.process) - before < PLACES + 20


def test_a_connection_that_sends_no_request_with_the_token_is_closed(desk):
    begin_s = time.monotonic()
    with (
        socket.create_connection(("127.0.0.1", desk.port)) as silent,
        socket.create_connection(("127.0.0.1", desk.port)) as refused,
    ):
        for connection in (silent, refused):
            connection.settimeout(PATIENCE_S)
        refused.send(b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
        assert b"403" in refused.recv(10_000)
        while refused.recv(10_000):
            pass
        # the system ends a connection that is aborted by an error or by its end
        with contextlib.suppress(ConnectionResetError):
            assert silent.recv(1) == b""
        assert time.monotonic() - begin_s > connections.FIRST_REQUEST_S


# -- rules for browsers


def test_no_site_may_frame_the_desk_and_files_are_sandboxed(desk):
    client = entered(desk)
    for path in ("/", "/?token=wrong", "/file/reports/report.html", "/file/reports/picture.svg"):
        headers = client.get(path).headers
        assert "frame-ancestors 'none'" in headers["Content-Security-Policy"]
        assert headers["X-Frame-Options"] == "DENY"
        assert headers["X-Content-Type-Options"] == "nosniff"
        policy = headers["Content-Security-Policy"]
        is_file = path.startswith("/file/")
        assert policy.startswith("sandbox ") is is_file
        assert ("script" in policy) is not is_file


def test_a_browser_loses_the_token_and_runs_no_script_of_a_report(desk, tmp_path):
    here = f"http://127.0.0.1:{desk.port}/"
    with browsing() as browser:
        # as --open opens it: by a file, which is another site for the browser
        doorstep = tmp_path / "open.html"
        doorstep.write_text(server.DOORSTEP.format(address=desk.address))
        browser.get(doorstep.as_uri())
        until(lambda: browser.current_url == here, "the address without the token")
        find = "//*[contains(text(), 'This page has no safety function')]"
        until(lambda: browser.find_elements("xpath", find), "the page")
        # the page works under its policy: the script has put its figures in
        dash = "return document.getElementById('desk-time')?.textContent"
        until(lambda: browser.execute_script(dash) == "no bench", "the figures")
        broken = [entry for entry in browser.get_log("browser") if "Policy" in entry["message"]]
        assert broken == []

        browser.get(here + "file/reports/report.html")
        browser.find_element("id", "next").click()
        until(lambda: browser.title == "the next report", "the next report")
        browser.back()
        until(lambda: browser.title == "report", "the first report, whose script has not run")
