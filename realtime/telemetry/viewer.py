"""Opens recorded runs in the Rerun viewer, lays runs over one another, and takes pictures of them.

The viewer is a program of its own. It listens on loopback only, and its own reporting of use is
switched off by a configuration folder that it is given. Without a display the command is told
that serves the run to a browser on this machine.
"""

import contextlib
import io
import json
import os
import shlex
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import rerun as rr
from PIL import Image
from rerun.experimental import ViewerClient

from rollerrig.configs.errors import RollerrigError
from rollerrig.configs.processes import children
from rollerrig.realtime.record import records, run_folder
from rollerrig.realtime.telemetry import derived, scene, views
from rollerrig.realtime.telemetry.drawing import Drawing

LOOPBACK = "127.0.0.1"
GRPC_PORT, WEB_PORT = 9876, 9090
_TITLE_BAR = 36  # points
_NO_GRAPHICS = (
    "no picture: the viewer ended, most likely for want of a Vulkan driver ({why}); install one, "
    "on Debian or Ubuntu with 'apt-get install mesa-vulkan-drivers libvulkan1' (it renders in "
    "software and needs no display)"
)


def has_display() -> bool:
    """Whether a window can be opened here."""
    return sys.platform in ("darwin", "win32") or any(
        os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY")
    )


def environment() -> dict[str, str]:
    """The environment for viewers: as ours, with the viewer's reporting of use switched off."""
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    try:
        home = _switched_off(cache / "rollerrig" / "viewer")
    except OSError:
        # no writable home: a folder of this process's own
        home = _switched_off(Path(tempfile.mkdtemp(prefix="rollerrig-viewer-")))
    level = os.environ.get("RUST_LOG", "error")
    return os.environ | {"XDG_CONFIG_HOME": str(home), "RUST_LOG": level}


def _switched_off(home: Path) -> Path:
    """A folder for XDG_CONFIG_HOME in which the viewer finds its reporting switched off."""
    own = home / "rerun" / "analytics.json"
    content = json.dumps(
        {
            "analytics_enabled": False,
            "analytics_id": "off",
            "metadata": {},
            "config_file_path": str(own),
            "data_dir_path": str(home / "data"),
        }
    )
    own.parent.mkdir(parents=True, exist_ok=True)
    # written once: a viewer that starts meanwhile shall not find it half written
    if not own.is_file() or own.read_text() != content:
        new = own.with_suffix(f".{os.getpid()}")
        new.write_text(content)
        new.replace(own)
    return home


def command(*arguments: str) -> list[str]:
    """The viewer's command line, bound to loopback."""
    return [
        sys.executable,
        "-m",
        "rerun_cli",
        "--bind",
        LOOPBACK,
        "--hide-welcome-screen",
        *arguments,
    ]


def serve_command(target: str, web_port: int = WEB_PORT) -> str:
    """What to type to see a file or an address in a browser on this machine."""
    return f"rerun --serve-web --bind {LOOPBACK} --web-viewer-port {web_port} {shlex.quote(target)}"


def page_address(web_port: int, port: int) -> str:
    """The address of the viewer's page that shows what a server on another port has."""
    return f"http://{LOOPBACK}:{web_port}/?url=rerun%2Bhttp://{LOOPBACK}:{port}/proxy"


def server_address(port: int) -> str:
    """Return the address of a Rerun server on a port of this machine."""
    return f"rerun+http://{LOOPBACK}:{port}/proxy"


def spawn(*arguments: str) -> subprocess.Popen:
    """Start a viewer that outlives us."""
    return subprocess.Popen(
        command(*arguments),
        env=environment(),
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )


def serve_page(web_port: int, address: str) -> subprocess.Popen:
    """Serve the page that shows what a server at an address has, as long as the calling thread lives."""
    program = Path(rr.__file__).parents[1] / "rerun_cli" / "rerun"
    words = command("--serve-web", "--web-viewer-port", str(web_port), address)
    words[:3] = (
        [str(program)] if program.is_file() else words[:3]
    )  # Python's would leave its own child behind
    return subprocess.Popen(
        children.command(*words),
        env=environment(),
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )


def terminate(process: subprocess.Popen) -> None:
    """End a viewer that `spawn` has started: it is a child of the process that we know."""
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGTERM)


def has_client(port: int) -> bool:
    """Whether anybody is connected to a TCP port of this machine; where the system does not tell: yes."""
    try:
        rows = [line.split() for line in Path("/proc/net/tcp").read_text().splitlines()[1:]]
    except OSError:
        return True
    return any(row[3] == "01" and int(row[1].rpartition(":")[2], 16) == port for row in rows)


def free_port(wanted: int = 0) -> int:
    """A free TCP port on loopback: the wanted one if it is free."""
    for port in (wanted, 0):
        with socket.socket() as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind((LOOPBACK, port))
            except OSError:
                continue
            return int(probe.getsockname()[1])
    raise RollerrigError(f"no free TCP port on {LOOPBACK}")


def recording_file(path: Path | str) -> Path:
    """The .rrd of a run's folder, or the .rrd itself. Raises ConfigError if there is none."""
    path = Path(path)
    if path.suffix == ".rrd" and path.is_file():
        return path
    records.load(path)  # says what is wrong with the folder
    own = path / run_folder.RRD
    return own if own.is_file() else overlay([path], own)


def overlay(runs: Sequence[Path | str], into: Path, bare: bool = False) -> Path:
    """Draw runs over one another into a new .rrd: the first bold, the others faint under /ref.

    Drawn from the channels, so it works for a run whose own .rrd is lost. All begin at t = 0. `bare`
    leaves out the viewer's own bars.
    """
    loaded = [records.load(run) for run in runs]
    names = _names([run.folder for run in loaded[1:]])
    first = loaded[0]
    stream = rr.RecordingStream(views.APPLICATION)
    layout = views.blueprint(
        bare=bare,
        eye=scene.eye(scene.geometry(first.scenario)),
        references=names,
        ends=views.axis_ends(dict(zip(first.table.column_names, first.table.columns, strict=True))),
    )
    stream.set_sinks(rr.FileSink(into), default_blueprint=layout)
    stream.send_recording_name(" over ".join(run.folder.resolve().name for run in loaded))
    for run, name in zip(loaded, ["", *names], strict=True):
        prefix = f"{views.REFERENCES}/{name}" if name else ""
        unit = str((run.summary.get("wsp") or {}).get("unit") or "")
        drawing = Drawing(stream, run.scenario, prefix, faint=bool(name), unit=unit)
        drawing.rows(records.rows(run.table))
        drawing.events(run.events)
    drawing.result("\n\n".join(derived.result_text(run.summary) for run in loaded))
    stream.disconnect()
    return into


def _names(folders: Sequence[Path]) -> list[str]:
    """A name for each folder that an entity path can hold, none twice."""
    names: list[str] = []
    for folder in folders:
        plain = "".join(c if c.isalnum() or c in "-_" else "_" for c in folder.resolve().name)
        names.append(plain if plain not in names else f"{plain}_{len(names) + 1}")
    return names


def open_run(paths: Sequence[Path | str]) -> dict[str, Any]:
    """Open runs in the viewer: `file` shown, `opened` a window, `command` for a browser. Raises ConfigError."""
    if len(paths) == 1:
        file = recording_file(paths[0])
    else:
        handle, name = tempfile.mkstemp(prefix="rollerrig-overlay-", suffix=".rrd")
        os.close(handle)
        file = overlay(paths, Path(name))
    if opened := has_display():
        spawn("--port", "auto", str(file))
    return {"file": str(file), "opened": opened, "command": serve_command(str(file))}


def picture(
    paths: Sequence[Path | str],
    png: Path | str,
    size: tuple[int, int] = (1600, 1000),
    time_s: float | None = None,
    timeout_s: float = 60.0,
) -> Path:
    """Take a picture of a run, or of several over one another, without a display.

    `size` in points, `time_s` the instant of the cursor (None: halfway). Raises ConfigError for a
    folder that is not a run's, RollerrigError where nothing can be drawn.
    """
    png = Path(png).resolve()
    if time_s is None:
        time_s = float(records.load(paths[0]).column("time_s").max(initial=0.0)) / 2.0
    with tempfile.TemporaryDirectory() as name:
        # drawn anew: an old recording gets today's layout, and a killed one its tail
        file = overlay(paths, Path(name) / "run.rrd", bare=True)
        shot = _headless(file, size, time_s, time.monotonic() + timeout_s)
    png.parent.mkdir(parents=True, exist_ok=True)
    # the viewer keeps the place of its title bar, empty
    image = Image.open(io.BytesIO(shot))
    image.crop((0, _TITLE_BAR * image.height // (size[1] + _TITLE_BAR), *image.size)).save(png)
    return png


def _headless(file: Path, size: tuple[int, int], time_s: float, until_s: float) -> bytes:
    """The picture, once two in a row are the same: the viewer fetches what it draws as it draws."""
    port, log = free_port(), file.with_name("log")
    with open(log, "wb") as sink:
        process = subprocess.Popen(
            command(
                "--headless",
                "--port",
                str(port),
                "--window-size",
                f"{size[0]}x{size[1] + _TITLE_BAR}",
                str(file),
            ),
            env=environment(),
            start_new_session=True,
            stdin=subprocess.DEVNULL,
            stdout=sink,
            stderr=sink,
        )
    try:
        client = _connected(process, port, log, until_s)
        client.set_time(views.TIMELINE, duration=time_s, play_state="paused")
        time.sleep(0.8)
        last = b""
        while time.monotonic() < until_s:
            shot = client.take_screenshot()
            if shot == last:
                return shot
            last = shot
            time.sleep(0.3)
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGTERM)
        process.wait(10)
    raise RollerrigError(
        "no picture: the viewer did not come to rest; try again when the machine is less busy"
    )


def _connected(process: subprocess.Popen, port: int, log: Path, until_s: float) -> ViewerClient:
    """A connection to the viewer when it has loaded the recording."""
    while time.monotonic() < until_s:
        if process.poll() is not None:
            said = [line for line in log.read_text(errors="replace").splitlines() if line.strip()]
            why = next((line for line in said if "panicked" in line), "it said nothing")
            raise RollerrigError(_NO_GRAPHICS.format(why=why.strip()[-160:]))
        try:
            client = ViewerClient.connect(f"rerun+http://{LOOPBACK}:{port}/proxy")
            state = client.get_state()
            if (
                state.active_recording
                and not state.loading
                and any(one.timelines for one in state.recordings)
            ):
                return client
        except Exception:
            # not listening yet; what the client raises then is not documented
            pass
        time.sleep(0.1)
    raise RollerrigError(
        "no picture: the viewer did not load the recording in time; is it "
        "damaged, or the machine very busy?"
    )
