"""How many processor cores this process may use."""

import math
import os
from pathlib import Path

# the folder of control groups (version 2), and the file that names the group of this process
_GROUPS = Path("/sys/fs/cgroup")
_OWN_GROUP = Path("/proc/self/cgroup")
_WITHOUT_LIMIT = "max"


def allowed(groups: Path = _GROUPS, own_group: Path = _OWN_GROUP) -> int:
    """Return the number of cores for work in parallel, at least 1.

    These are the cores to which the process is bound (taskset, cpuset), but not more than the
    processor time of its container allows (`--cpus` of docker and podman, a quota of systemd).
    """
    bound = len(os.sched_getaffinity(0))
    return math.ceil(min(max(_quota(groups, own_group), 1.0), bound))


def _quota(groups: Path, own_group: Path) -> float:
    """Return the processor time that the groups allow, in cores; infinite without a limit."""
    try:
        lines = own_group.read_text(encoding="ascii").splitlines()
    except OSError:
        return math.inf
    # the line of version 2 begins with 0::, and a container sees its own group as /
    paths = [line.removeprefix("0::/") for line in lines if line.startswith("0::/")]
    if not paths:
        return math.inf
    group = groups / paths[0]
    # a group has no more than each group that contains it
    return min(_limit(folder / "cpu.max") for folder in (group, *group.parents))


def _limit(file: Path) -> float:
    """Return the limit in a file: time and period in microseconds; infinite if there is none."""
    try:
        time, period = file.read_text(encoding="ascii").split()
        return math.inf if time == _WITHOUT_LIMIT else float(time) / float(period)
    except (OSError, ValueError, ZeroDivisionError):
        return math.inf
