"""`rollerrig check`: what this machine offers a bench, and how to enable what it does not.

Each function puts one question to the machine itself and not to a list of known machines: the port is
bound, the priority asked for in a thread that then ends, memory locked and let go. Exit status 0 when
a run is possible at all, 2 when it is not. Source of the remedies: the manual pages of sched(7),
mlock(2) and limits.conf(5), and the kernel's documentation of cpufreq and PM QoS.
"""

import argparse
import ctypes
import json
import os
import platform
import re
import resource
import shutil
import socket
import subprocess
import sys
import threading
from enum import StrEnum
from importlib import metadata
from pathlib import Path
from typing import NamedTuple

from rich.console import Console
from rich.table import Table

PASS, USAGE = 0, 2
OLDEST, NEWEST = (3, 11), (3, 13)
PRIORITY = 80
_ROOM_MB = 32
_ICDS = ("/usr/share/vulkan/icd.d", "/etc/vulkan/icd.d", "/usr/local/share/vulkan/icd.d")
_FREQUENCY = Path("/sys/devices/system/cpu/cpu0/cpufreq/scaling_governor")
_ISOLATED = Path("/sys/devices/system/cpu/isolated")
_LOOPBACK = "127.0.0.1"


class State(StrEnum):
    """How far a thing is there: WEAKER works with less, MISSING makes a run impossible."""

    OK = "ok"
    WEAKER = "weaker"
    MISSING = "missing"


class Finding(NamedTuple):
    """One answer: what was asked, how it is, what was found, and how to enable what is not there."""

    name: str
    state: State
    found: str
    mend: str = ""


def arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--port", type=int, default=29536, metavar="N",
                        help="the hub's port to look at (default: 29536)")


def call(given: argparse.Namespace) -> int:
    return show(look(given.port), given.json)


def show(findings: list[Finding], as_json: bool) -> int:
    """Print the findings; the exit status says whether a run is possible."""
    possible = all(one.state is not State.MISSING for one in findings)
    if as_json:
        print(json.dumps({"possible": possible, "checks": [one._asdict() for one in findings]}))
    else:
        Console().print(table(findings))
        print("a run is possible" if possible else "no run is possible before the rows that say "
              "'missing' are remedied", file=sys.stderr)
    return PASS if possible else USAGE


def look(hub_port: int) -> list[Finding]:
    """Ask the machine all questions, in the order of the table."""
    return [python(), packages(), kernels(), shared_memory(), loopback(), socketcan(), port(hub_port), cores(),
            priority(), memory_lock(), idle_states(), governor(), preemption(), display(), pictures(), cyclictest()]


_COLOURS = {State.OK: "green", State.WEAKER: "yellow", State.MISSING: "bold red"}


def table(findings: list[Finding]) -> Table:
    """The findings for a terminal."""
    shown = Table(title="what this machine can do", title_justify="left")
    for head in ("what", "state", "found", "how to enable"):
        shown.add_column(head, overflow="fold")
    for one in findings:
        shown.add_row(one.name, f"[{_COLOURS[one.state]}]{one.state}[/]", one.found, one.mend)
    return shown


# --- the questions ---

def python() -> Finding:
    """Whether this Python is one that the project is tested with."""
    here = f"{platform.python_version()}, {platform.system()} {platform.release()}"
    if not OLDEST <= sys.version_info[:2] <= NEWEST:
        return Finding("Python", State.MISSING, here, "make a new environment with Python 3.11 to "
                       "3.13: make PYTHON=python3.12 ...")
    if sys.platform != "linux":
        return Finding("Python", State.MISSING, here, "the real-time loop needs Linux; a virtual "
                       "machine or container will do")
    return Finding("Python", State.OK, here)


def packages() -> Finding:
    """Whether every package that the project requires is installed."""
    wanted = [re.split(r"[^A-Za-z0-9_.-]", one, maxsplit=1)[0]
              for one in metadata.requires("rollerrig") or () if "extra ==" not in one]
    found, absent = [f"rollerrig {metadata.version('rollerrig')}"], []
    for name in wanted:
        try:
            found.append(f"{name} {metadata.version(name)}")
        except metadata.PackageNotFoundError:
            absent.append(name)
    if absent:
        return Finding("packages", State.MISSING, f"without {', '.join(absent)}",
                       f"pip install {' '.join(absent)} (or make demo)")
    return Finding("packages", State.OK, ", ".join(found))


def kernels() -> Finding:
    """Whether the first run has to compile, and whether it can keep what it compiles."""
    from rollerrig.rig import kernel

    folder = getattr(kernel.settings, "CACHE_DIR", "")
    if kernel.is_compiled():
        return Finding("compiled kernels", State.OK, f"in {folder}")
    if folder and os.access(folder, os.W_OK):
        return Finding("compiled kernels", State.OK, "none yet: the first run compiles, half a "
                       "minute")
    return Finding("compiled kernels", State.WEAKER, "every run compiles: no folder to keep them in",
                   "make ~/.cache writable, or set XDG_CACHE_HOME")


def shared_memory() -> Finding:
    """Whether there is room for the rings of a run."""
    from rollerrig.realtime.loop import ring

    folder = ring.folder()
    free_MB = shutil.disk_usage(folder).free / 1e6
    found = f"{free_MB:.0f} MB free in {folder}"
    if free_MB < _ROOM_MB:
        return Finding("shared memory", State.MISSING, found,
                       f"make {_ROOM_MB} MB of room in {folder} (in a container: --shm-size=64m)")
    if str(folder) != "/dev/shm":
        return Finding("shared memory", State.WEAKER, found, "mount a tmpfs on /dev/shm: a disk may "
                       "hold the loop up")
    return Finding("shared memory", State.OK, found)


def loopback() -> Finding:
    """Whether the hub can listen at all."""
    if _bind(0):
        return Finding("hub on loopback", State.OK, f"can listen on {_LOOPBACK}")
    return Finding("hub on loopback", State.MISSING, f"cannot listen on {_LOOPBACK}",
                   "sudo ip link set lo up")


def socketcan() -> Finding:
    """Kernel CAN, which takes the place of the hub where its vcan0 is up."""
    from rollerrig.wsp_interface.bus import buses

    kernel_can = buses.available()
    if kernel_can.up:
        return Finding("SocketCAN", State.OK, f"up: {', '.join(kernel_can.up)}",
                       "; ".join(kernel_can.hints))
    found = "no interface is up" if kernel_can.af_can else "not in this kernel"
    return Finding("SocketCAN", State.WEAKER, f"{found}: the bench's own hub is the bus",
                   "; ".join(kernel_can.hints))


def port(number: int) -> Finding:
    """Whether the hub's port is free, and who has it if not."""
    name = f"port {number}"
    if _bind(number):
        return Finding(name, State.OK, "free")
    mend = (f"end its holder, or give the bench another: --set bus.socketcand_port=0 takes any; "
            f"ss -ltnp 'sport = :{number}' shows who it is")
    return Finding(name, State.WEAKER, f"in use{_holder(number)}", mend)


def cores() -> Finding:
    """The real-time thread wants one core, and the bus, recorder and unit another."""
    allowed = sorted(os.sched_getaffinity(0))
    isolated = _ISOLATED.read_text().strip() if _ISOLATED.is_file() else ""
    found = f"{len(allowed)} may be used" + (f", isolated: {isolated}" if isolated else "")
    if len(allowed) < 2:
        return Finding("cores", State.WEAKER, found, "give the process a second core (taskset, "
                       "cpuset or container limits): bus and loop now share one")
    return Finding("cores", State.OK, found)


def priority() -> Finding:
    """Whether a thread may have SCHED_FIFO."""
    refused: list[str] = []

    def ask() -> None:
        try:
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
        except OSError as error:
            refused.append(error.strerror or "refused")

    # of a thread, not of the process: it ends with its priority
    thread = threading.Thread(target=ask)
    thread.start()
    thread.join()
    name = f"SCHED_FIFO {PRIORITY}"
    if not refused:
        return Finding(name, State.OK, "allowed")
    return Finding(name, State.WEAKER, f"{refused[0]}: late ticks where the machine is busy",
                   f"'{_user()} - rtprio 90' in /etc/security/limits.conf and a new login, or "
                   "CAP_SYS_NICE (container: --cap-add=sys_nice --ulimit rtprio=90)")


def memory_lock() -> Finding:
    """Whether pages may be kept in memory; they are let go again."""
    from rollerrig.realtime.loop import clock

    reason = clock.lock_memory()
    ctypes.CDLL(None).munlockall()
    if not reason:
        return Finding("memory lock", State.OK, "allowed")
    soft = resource.getrlimit(resource.RLIMIT_MEMLOCK)[0]
    return Finding("memory lock", State.WEAKER, f"{reason} (limit {soft // 1024} KiB)",
                   f"'{_user()} - memlock unlimited' in /etc/security/limits.conf and a new login, "
                   "or CAP_IPC_LOCK (container: --cap-add=ipc_lock --ulimit memlock=-1)")


def idle_states() -> Finding:
    """Whether cores can be kept from sleeping deeply while a run is on."""
    from rollerrig.realtime.loop import clock

    with clock.awake() as reason:
        if not reason:
            return Finding("idle states", State.OK, "a run keeps the cores awake")
    return Finding("idle states", State.WEAKER, f"{clock.IDLE_LIMIT}: {reason}; a sleeping core "
                   "takes tens of us to wake", f"sudo chmod o+w {clock.IDLE_LIMIT} (until the next "
                   "boot), or a udev rule for it")


def governor() -> Finding:
    """Whether the processor's clock is free to fall."""
    if not _FREQUENCY.is_file():
        return Finding("processor governor", State.OK, "none here: a virtual machine, or fixed")
    found = _FREQUENCY.read_text().strip()
    if found == "performance":
        return Finding("processor governor", State.OK, found)
    return Finding("processor governor", State.WEAKER, found,
                   "sudo cpupower frequency-set -g performance")


def preemption() -> Finding:
    """How the kernel lets a real-time thread interrupt it."""
    version = platform.version()
    kind = re.search(r"PREEMPT\w*", version)
    if Path("/sys/kernel/realtime").is_file() or "PREEMPT_RT" in version:
        return Finding("kernel preemption", State.OK, "PREEMPT_RT")
    if kind:
        return Finding("kernel preemption", State.OK, f"{kind[0]} (PREEMPT_RT is best)")
    return Finding("kernel preemption", State.WEAKER, "none named", "boot with preempt=full, or a "
                   "PREEMPT_RT kernel")


def display() -> Finding:
    """Whether the viewer can open a window."""
    try:
        from rollerrig.realtime.telemetry import viewer
    except ImportError as error:
        return Finding("viewer", State.WEAKER, str(error), "pip install rerun-sdk")
    if viewer.has_display():
        return Finding("viewer", State.OK, "a display is there")
    return Finding("viewer", State.WEAKER, "no display: a run is served to a browser",
                   "set DISPLAY (ssh -X), or open what 'rollerrig view' prints in a browser")


def pictures() -> Finding:
    """Whether the viewer finds a Vulkan driver to draw with, as for `view --png`."""
    named = os.environ.get("VK_DRIVER_FILES") or os.environ.get("VK_ICD_FILENAMES") or ""
    drivers = [Path(one) for one in named.split(os.pathsep) if one] or [
        path for folder in _ICDS for path in sorted(Path(folder).glob("*.json"))]
    found = sorted({path.stem.split("_icd")[0] for path in drivers if path.is_file()})
    if found and _has_library("libvulkan.so.1"):
        return Finding("pictures (Vulkan)", State.OK, ", ".join(found))
    return Finding("pictures (Vulkan)", State.WEAKER, "no driver: 'rollerrig view --png' cannot draw",
                   "sudo apt-get install mesa-vulkan-drivers libvulkan1 (draws in software)")


def cyclictest() -> Finding:
    """Whether the loop can be compared with cyclictest."""
    program = shutil.which("cyclictest")
    if program:
        return Finding("cyclictest", State.OK, program)
    return Finding("cyclictest", State.WEAKER, "not here: 'rollerrig bench loop' has nothing to "
                   "compare with", "sudo apt-get install rt-tests")


def _bind(number: int) -> bool:
    with socket.socket() as probe:
        # as asyncio's servers do: a port that only waits for old connections is free
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((_LOOPBACK, number))
            probe.listen(1)
        except (OSError, OverflowError):
            return False
    return True


def _holder(number: int) -> str:
    """The program that listens on a port, as far as `ss` may tell; "" where it may not."""
    program = shutil.which("ss")
    if not program:
        return ""
    listing = subprocess.run([program, "-ltnpH", f"sport = :{number}"], capture_output=True, text=True,
                             timeout=5.0, check=False).stdout
    names = re.findall(r'\("([^"]+)",pid=(\d+)', listing)
    return " by " + ", ".join(f"{name} (process {pid})" for name, pid in names) if names else ""


def _has_library(name: str) -> bool:
    try:
        ctypes.CDLL(name)
    except OSError:
        return False
    return True


def _user() -> str:
    return os.environ.get("USER") or str(os.getuid())
