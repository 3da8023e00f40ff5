"""`rollerrig check`: prints what this machine offers to a bench and how to enable what is missing.

With an FMU, it prints instead whether the FMU fits the rig.

Each function tests one thing on the machine itself; there is no list of known machines. The port is
bound, the priority is requested in a thread that then exits, memory is locked and unlocked. Exit
status 2 means that no run is possible at all.

Source of the remedies: the manual pages sched(7), mlock(2) and limits.conf(5), and the kernel
documentation of cpufreq and PM QoS.
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
from enum import StrEnum
from importlib import metadata
from pathlib import Path
from typing import NamedTuple

from rollerrig.configs.errors import ConfigError
from rollerrig.configs.processes import memory
from rollerrig.configs.processes.cores import allowed as allowed_cores
from rollerrig.configs.vehicle import Kind
from rollerrig.realtime.commands import output, wsp

# exit statuses
PASS = 0
USAGE = 2

# versions of Python that the project is tested with
OLDEST_PYTHON = (3, 11)
NEWEST_PYTHON = (3, 13)

# priority that is requested for the test, of 1 to 99
PRIORITY = 80

# the rings of a run, with a reserve
_SHARED_MEMORY_MB = 32

_LOOPBACK = "127.0.0.1"

# folders with the description files of Vulkan drivers
_VULKAN_FOLDERS = ("/usr/share/vulkan/icd.d", "/etc/vulkan/icd.d", "/usr/local/share/vulkan/icd.d")

_GOVERNOR_FILE = Path("/sys/devices/system/cpu/cpu0/cpufreq/scaling_governor")
_ISOLATED_CORES_FILE = Path("/sys/devices/system/cpu/isolated")
# exists only in a PREEMPT_RT kernel
_REALTIME_FILE = Path("/sys/kernel/realtime")

_SS_TIMEOUT_S = 5.0
_HIGHEST_PORT = 65535


class State(StrEnum):
    """The state of a row. WEAKER: a run works with less. MISSING: no run is possible."""

    OK = "ok"
    WEAKER = "weaker"
    MISSING = "missing"


# who may write to a device that `check` recommends: the users of a group
_GROUP = "realtime"
_UDEV_RULES = "/etc/udev/rules.d/90-rollerrig.rules"
_COLOURS = {State.OK: "green", State.WEAKER: "yellow", State.MISSING: "bold red"}


class Finding(NamedTuple):
    """One row: what was tested, its state, what was found, and how to enable what is missing.

    The field names are keys of the JSON result.
    """

    name: str
    state: State
    found: str
    mend: str = ""


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `rollerrig check`."""
    parser.add_argument(
        "fmu",
        nargs="?",
        type=Path,
        metavar="FMU",
        help="a WSP unit that is an FMU: print its content and whether it fits, without running it "
        "(default: check this machine)",
    )
    wsp.map_argument(parser)
    parser.add_argument(
        "--write-map",
        type=Path,
        metavar="FILE",
        help="with an FMU whose variables have other names: write a proposal for --unit-map to "
        "correct, with all inputs and outputs of the FMU in its comments",
    )
    parser.add_argument(
        "--step",
        type=float,
        default=0.01,
        metavar="S",
        help="with an FMU: the SYNC period, which is the length of its steps (default: 0.01)",
    )
    wsp.axles_argument(parser, "with an FMU: ")
    parser.add_argument(
        "--port",
        type=int,
        default=29536,
        metavar="N",
        help="the port of the CAN hub, to check whether it is free (default: 29536)",
    )


def call(options: argparse.Namespace) -> int:
    """Check an FMU if one is given, otherwise this machine. Returns PASS or USAGE.

    Raises ConfigError for a port that cannot exist.
    """
    if options.write_map:
        return _write_map(options)
    if options.fmu:
        unit_axles = Kind(options.axles).unit_axles
        findings = check_fmu(options.fmu, options.unit_map, options.step, unit_axles)
        return show(options, findings, f"{options.fmu.name}: whether it fits the rig")
    if not 0 <= options.port <= _HIGHEST_PORT:
        raise ConfigError(
            f"--port {options.port}: allowed are numbers from 0 (any free port) to {_HIGHEST_PORT}"
        )
    return show(options, check_machine(options.port))


def _write_map(options: argparse.Namespace) -> int:
    """Write a proposal of a mapping for an FMU. Returns PASS. Raises ConfigError."""
    from rollerrig.firmware_sim.fmu import map_skeleton

    if not options.fmu:
        raise ConfigError("--write-map needs an FMU: rollerrig check unit.fmu --write-map map.toml")
    if options.write_map.exists():
        raise ConfigError(
            f"--write-map {options.write_map}: exists; remove it, or give another file"
        )
    unit_axles = Kind(options.axles).unit_axles
    unknown = map_skeleton.write(options.fmu, options.write_map, unit_axles)
    todo = "check its names and factors"
    if unknown:
        todo = f"{unknown} names were not recognised (?): fill them in, and check the factors"
    return output.show(
        options,
        {"file": str(options.write_map), "unknown": unknown},
        f"{options.write_map}: {todo}; then 'rollerrig check {options.fmu} --unit-map "
        f"{options.write_map}'",
    )


def show(
    options: argparse.Namespace, findings: list[Finding], title: str = "what this machine can do"
) -> int:
    """Print the findings. Returns PASS if a run is possible, otherwise USAGE."""
    possible = all(finding.state is not State.MISSING for finding in findings)

    # imported here because --json does not need it
    from rich.text import Text

    rows = []
    for finding in findings:
        state = Text(str(finding.state), _COLOURS[finding.state])
        rows.append((finding.name, state, finding.found, finding.mend))
    output.show(
        options,
        {"possible": possible, "checks": [finding._asdict() for finding in findings]},
        (title, ("what", "state", "found", "how to enable"), rows),
    )

    if not options.json:
        if possible:
            output.print_message("a run is possible")
        else:
            output.print_message(
                "no run is possible; first follow 'how to enable' in the rows marked 'missing'"
            )
    return PASS if possible else USAGE


def check_fmu(path: Path, unit_map: Path | None, period_s: float, unit_axles: int) -> list[Finding]:
    """Return the content of an FMU and whether it fits. Raises ConfigError if it is unreadable."""
    from rollerrig.firmware_sim.fmu import fmu_file

    _, examined = fmu_file.examine(path, unit_map, period_s, unit_axles)
    findings = []
    for row in examined:
        if row.fits:
            findings.append(Finding(row.name, State.OK, row.found))
        else:
            findings.append(Finding(row.name, State.MISSING, row.found, row.mend))
    return findings


def check_machine(hub_port: int) -> list[Finding]:
    """Return all findings about this machine, in the order of the table."""
    return [
        python(),
        packages(),
        kernels(),
        shared_memory(),
        loopback(),
        socketcan(),
        port(hub_port),
        cores(),
        core_of_loop(),
        priority(),
        memory_lock(),
        idle_states(),
        governor(),
        preemption(),
        display(),
        pictures(),
        cyclictest(),
    ]


def python() -> Finding:
    """Check whether the project is tested with this version of Python and runs on this system."""
    name = "Python"
    found = f"{platform.python_version()}, {platform.system()} {platform.release()}"
    if not OLDEST_PYTHON <= sys.version_info[:2] <= NEWEST_PYTHON:
        return Finding(
            name,
            State.MISSING,
            found,
            "make a new environment with Python 3.11 to 3.13: make PYTHON=python3.12 ...",
        )
    if sys.platform != "linux":
        return Finding(
            name,
            State.MISSING,
            found,
            "the real-time loop needs Linux; use a Linux machine, virtual machine or container",
        )
    return Finding(name, State.OK, found)


def packages() -> Finding:
    """Check whether every package that the project requires is installed."""
    name = "packages"
    installed: list[str] = []
    absent: list[str] = []
    for package in ("rollerrig", *_required_packages()):
        try:
            installed.append(f"{package} {metadata.version(package)}")
        except metadata.PackageNotFoundError:
            absent.append(package)

    if absent:
        return Finding(
            name,
            State.MISSING,
            f"not installed: {', '.join(absent)}",
            f"pip install {' '.join(absent)} (or make demo)",
        )
    return Finding(name, State.OK, ", ".join(installed))


def _required_packages() -> list[str]:
    """Return the names of the packages that rollerrig requires without its extras."""
    names: list[str] = []
    for requirement in metadata.requires("rollerrig") or ():
        if "extra ==" not in requirement:
            # the name ends where the version or a marker begins, as in numpy>=2.0
            package, *_ = re.split(r"[^A-Za-z0-9_.-]", requirement, maxsplit=1)
            names.append(package)
    return names


def kernels() -> Finding:
    """Check whether the kernels are compiled, and whether compiled kernels can be stored."""
    from rollerrig.rig.compiled import kernel_cache

    name = "compiled kernels"
    folder = kernel_cache.folder()
    if kernel_cache.is_compiled():
        return Finding(name, State.OK, f"in {folder}")
    if folder and os.access(folder, os.W_OK):
        return Finding(name, State.OK, "none yet: the first run compiles them for half a minute")
    reason = kernel_cache.refusal() or f"{folder} is not writable"
    return Finding(
        name,
        State.WEAKER,
        f"not kept, so every run compiles them again: {reason}",
        "set XDG_CACHE_HOME to a folder that only you can write to",
    )


def shared_memory() -> Finding:
    """Check whether there is enough shared memory for the rings of a run."""
    from rollerrig.realtime.loop import ring

    name = "shared memory"
    folder = ring.folder()
    free_MB = shutil.disk_usage(folder).free / 1e6
    found = f"{free_MB:.0f} MB free in {folder}"
    if free_MB < _SHARED_MEMORY_MB:
        return Finding(
            name,
            State.MISSING,
            found,
            f"free {_SHARED_MEMORY_MB} MB in {folder} (in a container: --shm-size=64m)",
        )
    if str(folder) != "/dev/shm":
        return Finding(
            name, State.WEAKER, found, "mount a tmpfs on /dev/shm: a disk can delay the loop"
        )
    return Finding(name, State.OK, found)


def loopback() -> Finding:
    """Check whether the CAN hub can listen on the loopback interface."""
    name = "hub on loopback"
    # port 0: any free port
    if _can_listen(0):
        return Finding(name, State.OK, f"can listen on {_LOOPBACK}")
    return Finding(name, State.MISSING, f"cannot listen on {_LOOPBACK}", "sudo ip link set lo up")


def socketcan() -> Finding:
    """Check for CAN interfaces of the kernel. If vcan0 is up, it can replace the CAN hub."""
    from rollerrig.wsp_interface.bus import kernel

    kernel_can = kernel.available()
    if kernel_can.up:
        state = State.OK
        found = f"up: {', '.join(kernel_can.up)}"
    else:
        state = State.WEAKER
        reason = "no interface is up" if kernel_can.af_can else "not in this kernel"
        found = f"{reason}: the bench uses its CAN hub as bus"
    # hints also come when an interface is up: another may be down, or a queue may be short
    return Finding("SocketCAN", state, found, "; ".join(kernel_can.hints))


def port(number: int) -> Finding:
    """Check whether the port of the CAN hub is free, and find the program that uses it."""
    name = f"port {number}"
    if _can_listen(number):
        return Finding(name, State.OK, "free")
    return Finding(
        name,
        State.WEAKER,
        f"in use{_user_of_port(number)}",
        "a run with the bench's unit takes a free port; for an outside unit stop the program that "
        "uses it, or give the bench another port: --set bus.socketcand_port=0 takes any free port; "
        f"ss -ltnp 'sport = :{number}' shows the program",
    )


def cores() -> Finding:
    """Check for two cores: one for the real-time thread, one for bus, recorder and unit."""
    count = allowed_cores()
    found = f"{count} available"
    isolated = _ISOLATED_CORES_FILE.read_text().strip() if _ISOLATED_CORES_FILE.is_file() else ""
    if isolated:
        found = f"{found}, isolated: {isolated}"

    if count > 1:
        return Finding("cores", State.OK, found)
    return Finding(
        "cores",
        State.WEAKER,
        found,
        "give the process a second core (taskset, cpuset or container limits), because bus and "
        "loop now share one core",
    )


def core_of_loop() -> Finding:
    """Check whether the loop can have a core for itself, and what else runs on that core."""
    from rollerrig.realtime.loop import cores as loop_cores
    from rollerrig.realtime.loop import interrupts, loop

    name = "core of the loop"
    claim = loop_cores.claim(loop_cores.CLAIM)
    if claim.number < 0:
        return Finding(
            name,
            State.WEAKER,
            "none is free",
            "give the process one more core than there are benches in real time, because the loop "
            "now shares its core with other threads",
        )
    with interrupts.kept_off(claim) as stay:
        core = claim.number
        if loop.priority_refused(PRIORITY):
            return Finding(
                name,
                State.WEAKER,
                f"{core} is free, but without SCHED_FIFO the loop runs on any core",
                f"allow SCHED_FIFO {PRIORITY}, see there",
            )
        if not stay:
            return Finding(name, State.OK, f"{core}, without interrupts of devices")
        return Finding(
            name,
            State.WEAKER,
            f"{core}; interrupts {', '.join(stay)} stay on it",
            "as root the bench moves interrupts, but not those that the kernel manages itself; "
            "/proc/interrupts names them; give the loop another core with loop.cpu",
        )


def priority() -> Finding:
    """Check whether a thread may run with the real-time policy SCHED_FIFO."""
    from rollerrig.realtime.loop import loop

    name = f"SCHED_FIFO {PRIORITY}"
    reason = loop.priority_refused(PRIORITY)
    if not reason:
        return Finding(name, State.OK, "allowed")
    return Finding(
        name,
        State.WEAKER,
        f"{reason}: ticks are late when the machine is busy",
        f"'{_user()} - rtprio 90' in /etc/security/limits.conf and a new login, or CAP_SYS_NICE "
        "(container: --cap-add=sys_nice --ulimit rtprio=90)",
    )


def memory_lock() -> Finding:
    """Check whether pages may be locked in memory. They are unlocked again."""
    name = "memory lock"
    reason = memory.lock()
    memory.unlock()
    if not reason:
        return Finding(name, State.OK, "allowed")

    soft_limit, _ = resource.getrlimit(resource.RLIMIT_MEMLOCK)
    limit = "no limit"
    if soft_limit != resource.RLIM_INFINITY:
        limit = f"limit {soft_limit // 1024} KiB"
    return Finding(
        name,
        State.WEAKER,
        f"{reason} ({limit})",
        f"'{_user()} - memlock unlimited' in /etc/security/limits.conf and a new login, or "
        "CAP_IPC_LOCK (container: --cap-add=ipc_lock --ulimit memlock=-1)",
    )


def idle_states() -> Finding:
    """Check whether a run can keep the cores out of deep idle states."""
    from rollerrig.realtime.loop import clock

    name = "idle states"
    with clock.awake() as reason:
        if not reason:
            return Finding(name, State.OK, "a run keeps the cores awake")
        return Finding(
            name,
            State.WEAKER,
            f"{clock.IDLE_LIMIT}: {reason}; an idle core needs tens of us to wake up",
            _group_may_write(clock.IDLE_LIMIT),
        )


def _group_may_write(device: str) -> str:
    """Return how the users of a group, and nobody else, may write to a device."""
    rule = f'KERNEL=="{Path(device).name}", GROUP="{_GROUP}", MODE="0660"'
    return (
        f"give a group the right to write: sudo groupadd -f {_GROUP}; "
        f"sudo usermod -aG {_GROUP} {_user()}; "
        f"echo '{rule}' | sudo tee {_UDEV_RULES}; then start the machine again"
    )


def governor() -> Finding:
    """Check whether the clock frequency of the processor can fall."""
    name = "processor governor"
    if not _GOVERNOR_FILE.is_file():
        return Finding(
            name, State.OK, "none: the machine is virtual, or its clock frequency is fixed"
        )
    found = _GOVERNOR_FILE.read_text().strip()
    if found == "performance":
        return Finding(name, State.OK, found)
    return Finding(name, State.WEAKER, found, "sudo cpupower frequency-set -g performance")


def preemption() -> Finding:
    """Check whether a real-time thread can interrupt the kernel."""
    name = "kernel preemption"
    if _REALTIME_FILE.is_file() or "PREEMPT_RT" in platform.version():
        return Finding(name, State.OK, "PREEMPT_RT")
    kind = re.search(r"PREEMPT\w*", platform.version())
    if kind:
        return Finding(name, State.OK, f"{kind[0]} (PREEMPT_RT is best)")
    return Finding(
        name,
        State.WEAKER,
        "the kernel version names none",
        "boot with preempt=full, or a PREEMPT_RT kernel",
    )


def display() -> Finding:
    """Check whether the viewer can open a window."""
    name = "viewer"
    try:
        from rollerrig.realtime.telemetry import viewer
    except ImportError as error:
        return Finding(name, State.WEAKER, str(error), "pip install rerun-sdk")

    if viewer.has_display():
        return Finding(name, State.OK, "a display is available")
    return Finding(
        name,
        State.WEAKER,
        "no display: 'rollerrig view' serves a run to a browser",
        "set DISPLAY (ssh -X), or open the address that 'rollerrig view' prints in a browser",
    )


def pictures() -> Finding:
    """Check whether `rollerrig view --png` finds a Vulkan driver to draw pictures."""
    name = "pictures (Vulkan)"
    drivers: set[str] = set()
    for file in _vulkan_driver_files():
        if file.is_file():
            # lvp_icd.x86_64.json describes the driver lvp
            driver, *_ = file.stem.split("_icd")
            drivers.add(driver)

    if drivers and _has_library("libvulkan.so.1"):
        return Finding(name, State.OK, ", ".join(sorted(drivers)))
    return Finding(
        name,
        State.WEAKER,
        "no driver: 'rollerrig view --png' cannot draw",
        "sudo apt-get install mesa-vulkan-drivers libvulkan1 (draws without a graphics card)",
    )


def _vulkan_driver_files() -> list[Path]:
    """Return the description files of Vulkan drivers, from the environment or from folders."""
    from_environment = os.environ.get("VK_DRIVER_FILES") or os.environ.get("VK_ICD_FILENAMES") or ""
    files = [Path(name) for name in from_environment.split(os.pathsep) if name]
    if files:
        return files
    for folder in _VULKAN_FOLDERS:
        files.extend(sorted(Path(folder).glob("*.json")))
    return files


def cyclictest() -> Finding:
    """Check whether cyclictest is installed, to which the loop can be compared."""
    program = shutil.which("cyclictest")
    if program:
        return Finding("cyclictest", State.OK, program)
    return Finding(
        "cyclictest",
        State.WEAKER,
        "not installed: 'rollerrig bench loop' makes no comparison",
        "sudo apt-get install rt-tests",
    )


def _can_listen(number: int) -> bool:
    """Return whether a server can listen on a port of the loopback interface."""
    with socket.socket() as probe:
        # as the servers of asyncio do: a port that only waits for old connections is free
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((_LOOPBACK, number))
            probe.listen(1)
        except (OSError, OverflowError):
            return False
    return True


def _user_of_port(number: int) -> str:
    """Return " by PROGRAM (process ID)" for a port, or "" if `ss` cannot find the program."""
    program = shutil.which("ss")
    if not program:
        return ""
    try:
        listing = subprocess.run(
            [program, "-ltnpH", f"sport = :{number}"],
            capture_output=True,
            text=True,
            timeout=_SS_TIMEOUT_S,
            check=False,
        ).stdout
    except subprocess.TimeoutExpired:
        return ""
    # ss prints: users:(("python",pid=4711,fd=6))
    users = re.findall(r'\("([^"]+)",pid=(\d+)', listing)
    if not users:
        return ""
    return " by " + ", ".join(f"{name} (process {pid})" for name, pid in users)


def _has_library(name: str) -> bool:
    """Return whether a shared library can be loaded."""
    with contextlib.suppress(OSError):
        return bool(ctypes.CDLL(name))
    return False


def _user() -> str:
    """Return the name of the user, or the user id if there is no name."""
    return os.environ.get("USER") or str(os.getuid())
