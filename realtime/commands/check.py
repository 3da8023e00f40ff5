"""`rollerrig check`: what this machine offers a bench, and how to enable what it does not; or whether an FMU fits.

Each function puts one question to the machine itself and not to a list of known machines: the port is bound, the
priority asked for in a thread that then ends, memory locked and let go. Exit status 2 when no run is possible at all.
Source of the remedies: the manual pages of sched(7), mlock(2) and limits.conf(5), the kernel's of cpufreq and PM QoS.
"""

import argparse
import contextlib
import ctypes
import os
import platform
import re
import resource
import shutil
import socket
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from enum import StrEnum
from importlib import metadata
from pathlib import Path
from typing import NamedTuple

from rollerrig.realtime.commands import output, wsp

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


_COLOURS = {State.OK: "green", State.WEAKER: "yellow", State.MISSING: "bold red"}


class Finding(NamedTuple):
    """One answer: what was asked, how it is, what was found, and how to enable what is not there."""

    name: str
    state: State
    found: str
    mend: str = ""


def arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "fmu",
        nargs="?",
        type=Path,
        metavar="FMU",
        help="a WSP unit: what it is and whether it fits, "
        "without running it (default: look at this machine)",
    )
    wsp.map_argument(parser)
    parser.add_argument(
        "--step",
        type=float,
        default=0.01,
        metavar="S",
        help="with an FMU: the SYNC period that it is to be stepped by (default: 0.01)",
    )
    parser.add_argument(
        "--port",
        type=int,
        default=29536,
        metavar="N",
        help="the hub's port to look at (default: 29536)",
    )


def call(given: argparse.Namespace) -> int:
    if given.fmu:
        return show(
            given,
            fits(given.fmu, given.unit_map, given.step),
            f"{given.fmu.name}: whether it fits the rig",
        )
    return show(given, look(given.port))


def fits(path: Path, unit_map: Path | None, period_s: float) -> list[Finding]:
    """What an FMU is, and whether it fits. Raises ConfigError where it cannot be read."""
    from rollerrig.firmware_sim.fmu import fmu_file

    return [
        _answer(one.name, one.fits, one.found, one.found, one.mend, State.MISSING)
        for one in fmu_file.examine(path, unit_map, period_s)[1]
    ]


def show(
    given: argparse.Namespace, findings: list[Finding], title: str = "what this machine can do"
) -> int:
    """Print the findings; the exit status says whether a run is possible."""
    possible = all(one.state is not State.MISSING for one in findings)
    output.show(
        given,
        {"possible": possible, "checks": [one._asdict() for one in findings]},
        (
            title,
            ("what", "state", "found", "how to enable"),
            (
                (one.name, f"[{_COLOURS[one.state]}]{one.state}[/]", one.found, one.mend)
                for one in findings
            ),
        ),
    )
    if not given.json:
        output.print_message(
            "a run is possible"
            if possible
            else "no run is possible before the rows that say 'missing' are remedied"
        )
    return PASS if possible else USAGE


def look(hub_port: int) -> list[Finding]:
    """Ask the machine all questions, in the order of the table."""
    return [
        python(),
        packages(),
        kernels(),
        shared_memory(),
        loopback(),
        socketcan(),
        port(hub_port),
        cores(),
        priority(),
        memory_lock(),
        idle_states(),
        governor(),
        preemption(),
        display(),
        pictures(),
        cyclictest(),
    ]


def _answer(
    name: str, right: object, found: str, wrong: str, mend: str, state: State = State.WEAKER
) -> Finding:
    """`found` where it is right, else what is wrong and how to enable it."""
    return Finding(name, State.OK, found) if right else Finding(name, state, wrong, mend)


def python() -> Finding:
    """Whether this Python, on this system, is one that the project is tested with."""
    here = f"{platform.python_version()}, {platform.system()} {platform.release()}"
    if not OLDEST <= sys.version_info[:2] <= NEWEST:
        return Finding(
            "Python",
            State.MISSING,
            here,
            "make a new environment with Python 3.11 to 3.13: make PYTHON=python3.12 ...",
        )
    return _answer(
        "Python",
        sys.platform == "linux",
        here,
        here,
        "the real-time loop needs Linux; a virtual machine or container will do",
        State.MISSING,
    )


def packages() -> Finding:
    """Whether every package that the project requires is installed."""
    wanted = [
        re.split(r"[^A-Za-z0-9_.-]", one, maxsplit=1)[0]
        for one in metadata.requires("rollerrig") or ()
        if "extra ==" not in one
    ]
    found, absent = [], []
    for name in ("rollerrig", *wanted):
        try:
            found.append(f"{name} {metadata.version(name)}")
        except metadata.PackageNotFoundError:
            absent.append(name)
    return _answer(
        "packages",
        not absent,
        ", ".join(found),
        f"without {', '.join(absent)}",
        f"pip install {' '.join(absent)} (or make demo)",
        State.MISSING,
    )


def kernels() -> Finding:
    """Whether the first run has to compile, and whether it can keep what it compiles."""
    from rollerrig.rig.compiled import kernel_cache

    folder = kernel_cache.folder()
    compiled = kernel_cache.is_compiled()
    return _answer(
        "compiled kernels",
        compiled or (folder and os.access(folder, os.W_OK)),
        f"in {folder}" if compiled else "none yet: the first run compiles, half a minute",
        "every run compiles: no folder to keep them in",
        "make ~/.cache writable, or set XDG_CACHE_HOME",
    )


def shared_memory() -> Finding:
    """Whether there is room for the rings of a run."""
    from rollerrig.realtime.loop import ring

    folder = ring.folder()
    free_MB = shutil.disk_usage(folder).free / 1e6
    found = f"{free_MB:.0f} MB free in {folder}"
    if free_MB < _ROOM_MB:
        return Finding(
            "shared memory",
            State.MISSING,
            found,
            f"make {_ROOM_MB} MB of room in {folder} (in a container: --shm-size=64m)",
        )
    return _answer(
        "shared memory",
        str(folder) == "/dev/shm",
        found,
        found,
        "mount a tmpfs on /dev/shm: a disk may hold the loop up",
    )


def loopback() -> Finding:
    """Whether the hub can listen at all."""
    return _answer(
        "hub on loopback",
        _bind(0),
        f"can listen on {_LOOPBACK}",
        f"cannot listen on {_LOOPBACK}",
        "sudo ip link set lo up",
        State.MISSING,
    )


def socketcan() -> Finding:
    """Kernel CAN, which takes the place of the hub where its vcan0 is up."""
    from rollerrig.wsp_interface.bus import kernel

    kernel_can = kernel.available()
    found = "no interface is up" if kernel_can.af_can else "not in this kernel"
    return _answer(
        "SocketCAN",
        kernel_can.up,
        f"up: {', '.join(kernel_can.up)}",
        f"{found}: the bench's own hub is the bus",
        "",
    )._replace(mend="; ".join(kernel_can.hints))


def port(number: int) -> Finding:
    """Whether the hub's port is free, and who has it if not."""
    free = _bind(number)
    return _answer(
        f"port {number}",
        free,
        "free",
        "in use" if free else f"in use{_holder(number)}",
        "end its holder, or give the bench another: --set bus.socketcand_port=0 takes any; "
        f"ss -ltnp 'sport = :{number}' shows who it is",
    )


def cores() -> Finding:
    """The real-time thread wants one core, and the bus, recorder and unit another."""
    allowed = len(os.sched_getaffinity(0))
    isolated = _ISOLATED.read_text().strip() if _ISOLATED.is_file() else ""
    found = f"{allowed} may be used" + (f", isolated: {isolated}" if isolated else "")
    return _answer(
        "cores",
        allowed > 1,
        found,
        found,
        "give the process a second core (taskset, cpuset or container "
        "limits): bus and loop now share one",
    )


def priority() -> Finding:
    """Whether a thread may have SCHED_FIFO."""
    # of a thread, not of the process: it ends with its priority
    with ThreadPoolExecutor(1) as thread:
        refused = thread.submit(
            os.sched_setscheduler, 0, os.SCHED_FIFO, os.sched_param(PRIORITY)
        ).exception()
    return _answer(
        f"SCHED_FIFO {PRIORITY}",
        not refused,
        "allowed",
        f"{getattr(refused, 'strerror', None) or 'refused'}: late ticks where the machine is busy",
        f"'{_user()} - rtprio 90' in /etc/security/limits.conf and a new login, or CAP_SYS_NICE "
        "(container: --cap-add=sys_nice --ulimit rtprio=90)",
    )


def memory_lock() -> Finding:
    """Whether pages may be kept in memory; they are let go again."""
    from rollerrig.realtime.loop import clock

    reason = clock.lock_memory()
    clock.unlock_memory()
    soft = resource.getrlimit(resource.RLIMIT_MEMLOCK)[0]
    return _answer(
        "memory lock",
        not reason,
        "allowed",
        f"{reason} (limit {soft // 1024} KiB)",
        f"'{_user()} - memlock unlimited' in /etc/security/limits.conf and a new login, or CAP_IPC_LOCK "
        "(container: --cap-add=ipc_lock --ulimit memlock=-1)",
    )


def idle_states() -> Finding:
    """Whether cores can be kept from sleeping deeply while a run is on."""
    from rollerrig.realtime.loop import clock

    with clock.awake() as reason:
        return _answer(
            "idle states",
            not reason,
            "a run keeps the cores awake",
            f"{clock.IDLE_LIMIT}: {reason}; a sleeping core takes tens of us to wake",
            f"sudo chmod o+w {clock.IDLE_LIMIT} (until the next boot), or a udev rule for it",
        )


def governor() -> Finding:
    """Whether the processor's clock is free to fall."""
    found = (
        _FREQUENCY.read_text().strip()
        if _FREQUENCY.is_file()
        else "none here: a virtual machine, or fixed"
    )
    return _answer(
        "processor governor",
        not _FREQUENCY.is_file() or found == "performance",
        found,
        found,
        "sudo cpupower frequency-set -g performance",
    )


def preemption() -> Finding:
    """How the kernel lets a real-time thread interrupt it."""
    kind = re.search(r"PREEMPT\w*", platform.version())
    best = Path("/sys/kernel/realtime").is_file() or "PREEMPT_RT" in platform.version()
    return _answer(
        "kernel preemption",
        best or kind,
        "PREEMPT_RT" if best or not kind else f"{kind[0]} (PREEMPT_RT is best)",
        "none named",
        "boot with preempt=full, or a PREEMPT_RT kernel",
    )


def display() -> Finding:
    """Whether the viewer can open a window."""
    try:
        from rollerrig.realtime.telemetry import viewer
    except ImportError as error:
        return Finding("viewer", State.WEAKER, str(error), "pip install rerun-sdk")
    return _answer(
        "viewer",
        viewer.has_display(),
        "a display is there",
        "no display: a run is served to a browser",
        "set DISPLAY (ssh -X), or open what 'rollerrig view' prints in a browser",
    )


def pictures() -> Finding:
    """Whether the viewer finds a Vulkan driver to draw with, as for `view --png`."""
    named = os.environ.get("VK_DRIVER_FILES") or os.environ.get("VK_ICD_FILENAMES") or ""
    drivers = [Path(one) for one in named.split(os.pathsep) if one] or [
        path for folder in _ICDS for path in sorted(Path(folder).glob("*.json"))
    ]
    found = sorted({path.stem.split("_icd")[0] for path in drivers if path.is_file()})
    return _answer(
        "pictures (Vulkan)",
        found and _has_library("libvulkan.so.1"),
        ", ".join(found),
        "no driver: 'rollerrig view --png' cannot draw",
        "sudo apt-get install mesa-vulkan-drivers libvulkan1 (draws in software)",
    )


def cyclictest() -> Finding:
    """Whether the loop can be compared with cyclictest."""
    program = shutil.which("cyclictest")
    return _answer(
        "cyclictest",
        program,
        program or "",
        "not here: 'rollerrig bench loop' has nothing to compare with",
        "sudo apt-get install rt-tests",
    )


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
    listing = subprocess.run(
        [program, "-ltnpH", f"sport = :{number}"],
        capture_output=True,
        text=True,
        timeout=5.0,
        check=False,
    ).stdout
    names = re.findall(r'\("([^"]+)",pid=(\d+)', listing)
    return " by " + ", ".join(f"{name} (process {pid})" for name, pid in names) if names else ""


def _has_library(name: str) -> bool:
    with contextlib.suppress(OSError):
        return bool(ctypes.CDLL(name))
    return False


def _user() -> str:
    return os.environ.get("USER") or str(os.getuid())
