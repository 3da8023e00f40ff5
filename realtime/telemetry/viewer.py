"""Opens recorded runs in the Rerun viewer, overlays several runs, and takes pictures of them.

The viewer is a separate program. It listens on loopback only. A configuration folder switches off
its reporting of use. On a machine without a display, the result is a command that serves the run to
a browser on this machine.
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
from typing import IO, Any

import rerun as rr
from PIL import Image
from rerun.experimental import ViewerClient

from rollerrig.configs import user_files
from rollerrig.configs.errors import ConfigError, RollerrigError
from rollerrig.configs.output_files import make_folder, replaced, write_bytes, writing
from rollerrig.configs.processes import children
from rollerrig.configs.vehicle import Kind
from rollerrig.realtime.record import records, run_folder
from rollerrig.realtime.telemetry import derived, scene, train_view, views
from rollerrig.realtime.telemetry.drawing import Drawing
from rollerrig.wsp_interface import signals

LOOPBACK = "127.0.0.1"
# the usual ports of Rerun
GRPC_PORT = 9876
WEB_PORT = 9090

# rows; a run is drawn in blocks of so many, because rows of all signals take much memory
_BLOCK_ROWS = 20_000

# height of the viewer's title bar, points
_TITLE_BAR = 36
# s; the viewer has drawn something after this time
_FIRST_SHOT_S = 0.8
# s; between two screenshots
_NEXT_SHOT_S = 0.3
# s; between two attempts to connect
_CONNECT_AGAIN_S = 0.1
# s; a viewer that is terminated has exited after this time
_EXIT_S = 10.0
# characters of the viewer's message that are shown
_MESSAGE_LENGTH = 160
_NO_GRAPHICS = (
    "no picture: the viewer exited, probably because there is no Vulkan driver ({why}); install "
    "one. On Debian or Ubuntu: 'apt-get install mesa-vulkan-drivers libvulkan1' (it renders in "
    "software and needs no display)"
)

# fields of a row of /proc/net/tcp, and the value for an open connection
_TCP_LOCAL_ADDRESS = 1
_TCP_STATE = 3
_TCP_ESTABLISHED = "01"


def has_display() -> bool:
    """Return whether a window can be opened here."""
    if sys.platform in ("darwin", "win32"):
        return True
    return any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY"))


def environment() -> dict[str, str]:
    """Return the environment for viewers: that of this process, without reporting of use."""
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    try:
        home = _switched_off(cache / "rollerrig" / "viewer")
    except OSError:
        # there is no writable home
        home = _switched_off(Path(tempfile.mkdtemp(prefix="rollerrig-viewer-")))
    level = os.environ.get("RUST_LOG", "error")
    return os.environ | {"XDG_CONFIG_HOME": str(home), "RUST_LOG": level}


def _switched_off(home: Path) -> Path:
    """Return `home` as a folder for XDG_CONFIG_HOME that switches off the viewer's reporting.

    Raises OSError if the folder is not writable.
    """
    settings = home / "rerun" / "analytics.json"
    content = json.dumps(
        {
            "analytics_enabled": False,
            "analytics_id": "off",
            "metadata": {},
            "config_file_path": str(settings),
            "data_dir_path": str(home / "data"),
        }
    )
    settings.parent.mkdir(parents=True, exist_ok=True)
    if not settings.is_file() or settings.read_text() != content:
        # replace it in one step: a viewer that starts now must not read half a file
        new = settings.with_suffix(f".{os.getpid()}")
        new.write_text(content)
        new.replace(settings)
    return home


def command(*arguments: str) -> list[str]:
    """Return the command line of the viewer, bound to loopback."""
    return [
        *children.module("rerun_cli"),
        "--bind",
        LOOPBACK,
        "--hide-welcome-screen",
        *arguments,
    ]


def serve_command(target: str, web_port: int = WEB_PORT) -> str:
    """Return the command that shows a file or an address in a browser on this machine."""
    return f"rerun --serve-web --bind {LOOPBACK} --web-viewer-port {web_port} {shlex.quote(target)}"


def page_address(web_port: int, port: int) -> str:
    """Return the address of a viewer page; it shows the data of the Rerun server on `port`."""
    return f"http://{LOOPBACK}:{web_port}/?url=rerun%2Bhttp://{LOOPBACK}:{port}/proxy"


def server_address(port: int) -> str:
    """Return the address of a Rerun server on a port of this machine."""
    return f"rerun+http://{LOOPBACK}:{port}/proxy"


def spawn(*arguments: str) -> subprocess.Popen:
    """Start a viewer that outlives this process."""
    return _start(command(*arguments))


def serve_page(web_port: int, address: str) -> subprocess.Popen:
    """Serve a page that shows the data of the server at an address.

    The page is served as long as the calling thread lives.
    """
    words = command("--serve-web", "--web-viewer-port", str(web_port), address)
    # `python -m rerun_cli` starts this program as a child and would leave it behind
    program = Path(rr.__file__).parents[1] / "rerun_cli" / "rerun"
    if program.is_file():
        python_and_module = 3
        words = [str(program), *words[python_and_module:]]
    return _start(children.command(*words))


def _start(words: list[str], output: int | IO[bytes] = subprocess.DEVNULL) -> subprocess.Popen:
    """Start a viewer as the leader of a new process group.

    So `terminate` also reaches the child processes of the viewer.
    """
    return subprocess.Popen(
        words,
        env=environment(),
        stdin=subprocess.DEVNULL,
        stdout=output,
        stderr=output,
        start_new_session=True,
    )


def terminate(process: subprocess.Popen) -> None:
    """Terminate a viewer that `spawn` has started, together with its child processes."""
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGTERM)


def has_client(port: int) -> bool:
    """Return whether a client is connected to a TCP port of this machine.

    True if the system does not report its connections.
    """
    try:
        lines = Path("/proc/net/tcp").read_text().splitlines()
    except OSError:
        return True

    for line in lines[1:]:
        fields = line.split()
        local_port = int(fields[_TCP_LOCAL_ADDRESS].rpartition(":")[2], 16)
        if fields[_TCP_STATE] == _TCP_ESTABLISHED and local_port == port:
            return True
    return False


def free_port(wanted: int = 0) -> int:
    """Return a free TCP port on loopback: the wanted one if it is free, otherwise any.

    Raises RollerrigError if there is none.
    """
    for port in (wanted, 0):
        with socket.socket() as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind((LOOPBACK, port))
            except OSError:
                continue
            return int(probe.getsockname()[1])
    raise RollerrigError(f"no free TCP port on {LOOPBACK}; close programs that listen there")


def recording_file(path: Path | str) -> Path:
    """Return the .rrd file of a run folder, or the path itself if it is a .rrd file.

    A folder without a .rrd file gets one. Raises ConfigError if the path is neither.
    """
    path = Path(path)
    if path.suffix == ".rrd" and path.is_file():
        return path

    # raises ConfigError if this is not a run folder
    records.load(path)
    recording = path / run_folder.RRD
    if recording.is_file():
        return user_files.check(recording, user_files.RRD, within=path)
    return overlay([path], recording)


def overlay(runs: Sequence[Path | str], into: Path, bare: bool = False) -> Path:
    """Draw several runs into a new .rrd file and return its path.

    The first run is bold, the others are faint and have paths below /ref. The source is the
    recorded channels, so a run needs no .rrd file. All runs begin at t = 0. `bare` leaves out the
    bars of the viewer. Raises ConfigError if a folder is not a run folder.
    """
    loaded = [records.load(run) for run in runs]
    with writing(into):
        write_bytes(into, _drawn_over(loaded, bare))
    return into


def _drawn_over(loaded: Sequence[records.Run], bare: bool) -> bytes:
    """Return a recording of several runs, as `overlay`.

    It is made in memory: when the disk is full, Rerun would wait for it for ever.
    """
    trains = [run for run in loaded if run.is_train]
    if trains and len(loaded) == 1:
        return train_view.recording(trains[0], bare)
    if trains:
        raise ConfigError(
            f"{trains[0].folder} is the run of a train, which is shown alone; allowed with other runs "
            "are its cars, in the folders car_1, car_2 ..."
        )

    first = loaded[0]
    names = _entity_names([run.folder for run in loaded[1:]])

    stream = rr.RecordingStream(views.APPLICATION)
    channels = dict(zip(first.table.column_names, first.table.columns, strict=True))
    layout = views.blueprint(
        signals.table(_with_all([run.kind for run in loaded])),
        bare=bare,
        eye=scene.eye(scene.geometry(first.kind, first.scenario)),
        references=names,
        ends=views.axis_ends(first.signal_table, channels),
    )
    memory = stream.memory_recording()
    stream.send_blueprint(layout)
    stream.send_recording_name(
        " over ".join(run_folder.short_names([run.folder for run in loaded]))
    )

    prefixes = ["", *(f"{views.REFERENCES}/{name}" for name in names)]
    for run, prefix in zip(loaded, prefixes, strict=True):
        wsp = run.summary.get("wsp") or {}
        drawing = Drawing(
            stream,
            run.signal_table,
            run.scenario,
            prefix=prefix,
            faint=bool(prefix),
            unit=str(wsp.get("unit") or ""),
        )
        for first_row in range(0, len(run.table), _BLOCK_ROWS):
            block = run.table.slice(first_row, _BLOCK_ROWS)
            drawing.rows(records.rows(block, run.signal_table))
        drawing.events(run.events)

    drawing.result("\n\n".join(derived.result_text(run.summary) for run in loaded))
    return memory.drain_as_bytes()


def _with_all(kinds: Sequence[Kind]) -> Kind:
    """Return the kind of a vehicle that has the axles and the equipment of all of these."""
    return Kind(
        axles=max(kind.axles for kind in kinds),
        dynamic_brake=any(kind.dynamic_brake for kind in kinds),
        magnetic_track_brake=any(kind.magnetic_track_brake for kind in kinds),
    )


def _entity_names(folders: Sequence[Path]) -> list[str]:
    """Return a unique name for each folder, of characters that an entity path may have."""
    names: list[str] = []
    for folder_name in run_folder.short_names(folders):
        name = "".join(c if c.isalnum() or c in "-_" else "_" for c in folder_name)
        if name in names:
            name = f"{name}_{len(names) + 1}"
        names.append(name)
    return names


def open_run(paths: Sequence[Path | str]) -> dict[str, Any]:
    """Open runs in the viewer, if there is a display.

    Returns a dictionary: `file` is the .rrd file, `opened` is whether a window was opened,
    `because` is the reason if none was, and `command` shows the file in a browser. Raises
    ConfigError if a path is not a run.
    """
    if len(paths) == 1:
        file = recording_file(paths[0])
    else:
        handle, name = tempfile.mkstemp(prefix="rollerrig-overlay-", suffix=".rrd")
        os.close(handle)
        file = overlay(paths, Path(name))

    result: dict[str, Any] = {"file": str(file), "opened": has_display()}
    if result["opened"]:
        spawn("--port", "auto", str(file))
    else:
        result["because"] = (
            "this machine has no display (DISPLAY and WAYLAND_DISPLAY are not set); the command "
            "shows the run in a browser, and view --png draws it"
        )
    return result | {"command": serve_command(str(file))}


def picture(
    paths: Sequence[Path | str],
    png: Path | str,
    size: tuple[int, int] = (1600, 1000),
    time_s: float | None = None,
    timeout_s: float = 60.0,
) -> Path:
    """Take a picture of a run, or of several runs in one picture; return its path.

    It needs no display.

    Args:
        paths: folders of runs; the first run is bold, the others are faint.
        png: the file of the picture.
        size: width and height in points.
        time_s: time of the cursor; None is halfway.
        timeout_s: the longest time that the viewer may take.

    Raises:
        ConfigError: a folder is not a run folder.
        RollerrigError: the viewer cannot draw.
    """
    png = Path(png).absolute()
    if time_s is None:
        time_s = float(records.load(paths[0]).column("time_s").max(initial=0.0)) / 2.0
    with tempfile.TemporaryDirectory() as name:
        # draw again: an old recording gets the present layout, and that of a killed run is complete
        file = overlay(paths, Path(name) / "run.rrd", bare=True)
        screenshot = _headless(file, size, time_s, time.monotonic() + timeout_s)

    # the viewer leaves the place of its title bar empty
    image = Image.open(io.BytesIO(screenshot))
    height_with_bar = size[1] + _TITLE_BAR
    top = _TITLE_BAR * image.height // height_with_bar
    with writing(png, "give another file with --png"):
        make_folder(png.parent)
        with replaced(png, ".png") as new:
            image.crop((0, top, image.width, image.height)).save(new)
    return png


def _headless(file: Path, size: tuple[int, int], time_s: float, until_s: float) -> bytes:
    """Return a screenshot of a recording at a time, as a PNG file.

    `until_s` is the latest monotonic time. Raises RollerrigError if the viewer cannot draw.
    """
    port = free_port()
    log = file.with_name("log")
    width, height = size
    words = command(
        "--headless",
        "--port",
        str(port),
        "--window-size",
        f"{width}x{height + _TITLE_BAR}",
        str(file),
    )
    with open(log, "wb") as sink:
        process = _start(words, sink)
    try:
        client = _connected(process, port, log, until_s)
        client.set_time(views.TIMELINE, duration=time_s, play_state="paused")
        return _steady_screenshot(client, until_s)
    finally:
        terminate(process)
        process.wait(_EXIT_S)


def _steady_screenshot(client: ViewerClient, until_s: float) -> bytes:
    """Return the first screenshot that equals the one before it.

    The viewer loads data while it draws, so its first pictures are incomplete. Raises
    RollerrigError if there is none until the monotonic time `until_s`.
    """
    time.sleep(_FIRST_SHOT_S)
    last = b""
    while time.monotonic() < until_s:
        screenshot = client.take_screenshot()
        if screenshot == last:
            return screenshot
        last = screenshot
        time.sleep(_NEXT_SHOT_S)
    raise RollerrigError(
        "no picture: the viewer still changes its picture; try again when the machine is less busy"
    )


def _connected(process: subprocess.Popen, port: int, log: Path, until_s: float) -> ViewerClient:
    """Return a connection to the viewer when the viewer has loaded the recording.

    Raises RollerrigError if the viewer exits or has not loaded it until the monotonic time
    `until_s`.
    """
    while time.monotonic() < until_s:
        if process.poll() is not None:
            raise RollerrigError(_NO_GRAPHICS.format(why=_reason_of_exit(log)))
        try:
            client = ViewerClient.connect(server_address(port))
            if _has_loaded(client):
                return client
        except Exception:
            # it does not listen yet; Rerun does not document the exception of its client
            pass
        time.sleep(_CONNECT_AGAIN_S)
    raise RollerrigError(
        "no picture: the viewer did not load the recording in time; check whether the recording "
        "is damaged, or try again when the machine is less busy"
    )


def _reason_of_exit(log: Path) -> str:
    """Return the line of the viewer's log that has the reason of its exit."""
    for line in log.read_text(errors="replace").splitlines():
        if "panicked" in line:
            return line.strip()[-_MESSAGE_LENGTH:]
    return "its log has no reason"


def _has_loaded(client: ViewerClient) -> bool:
    """Return whether the viewer has loaded a recording with a timeline."""
    state = client.get_state()
    if not state.active_recording or state.loading:
        return False
    return any(recording.timelines for recording in state.recordings)
