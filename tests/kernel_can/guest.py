"""Runs a command on a kernel with SocketCAN, where `vcan0` is up, without any privilege.

    python tests/kernel_can/guest.py candump vcan0

The command runs as root of a user-mode Linux, which is a kernel in an ordinary process (Debian's
package `user-mode-linux`). It sees the files of this machine at the same paths, and the environment
of this process. Its network has only a loopback and `vcan0`, and its standard input is empty. It
has one core. Arithmetic is as fast as outside; a system call is 20 to 45 times slower. Packages are
downloaded and unpacked once, into `$XDG_CACHE_HOME/rollerrig/kernel-can`, and not installed. The
exit status is that of the command, or 125 if there can be no guest.
"""

import os
import platform
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
from pathlib import Path

HERE = Path(__file__).resolve().parent
PACKAGES = ("user-mode-linux", "busybox-static", "can-utils")
TOOLS = ("apt-get", "dpkg-deb", "gcc")
MEMORY = "3G"
MEMORY_FILE_BYTES = 4e9  # free space for it, with a margin
NO_GUEST = 125  # exit status
# the tests need about 200 s, and share their core with others
LONGEST_S = 1800.0


class GuestError(Exception):
    """The guest could not be made, or stopped before its command."""


def missing() -> str:
    """Return why no guest can run on this machine; empty if a guest can run."""
    system = platform.system()
    machine = platform.machine()
    if system != "Linux" or machine != "x86_64":
        return f"user-mode Linux needs Linux on x86_64; this is {system} on {machine}"
    absent = [tool for tool in TOOLS if not shutil.which(tool)]
    if absent:
        return f"this machine has no {', '.join(absent)}"
    return ""


def unpacked() -> Path:
    """Return the folder of the guest's kernel and tools; make it if needed. Raises GuestError."""
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "rollerrig"
    folder = cache / "kernel-can"
    if folder.exists():
        return folder
    cache.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=cache) as name:
        new = Path(name, "guest")
        new.mkdir()
        for package in PACKAGES:
            _call(name, "apt-get", "download", "-qq", "-o", "APT::Sandbox::User=root", package)
        for file in Path(name).glob("*.deb"):
            _call(name, "dpkg-deb", "-x", str(file), str(new))
        library = str(new / "amx.so")
        _call(name, "gcc", "-O2", "-shared", "-fPIC", "-o", library, str(HERE / "amx.c"))
        for applet in ("ip", "insmod"):
            (new / "usr/bin" / applet).symlink_to(folder / "bin/busybox")
        try:
            new.rename(folder)
        except OSError:
            # if the folder is there now, another process was faster
            if not folder.exists():
                raise
    return folder


def _call(folder: str, *command: str) -> None:
    """Run a command in a folder. Raises GuestError if it fails."""
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True)
    if done.returncode:
        raise GuestError(
            f"{shlex.join(command)}: {done.stderr.strip()} (package lists: apt-get update)"
        )


def run(command: list[str], timeout_s: float = LONGEST_S, out=sys.stdout, err=sys.stderr) -> int:
    """Run a command in a new guest; return its exit status. Its output goes to `out` and `err`.

    Raises GuestError if there can be no guest, or if the command has not exited after timeout_s.
    """
    if reason := missing():
        raise GuestError(reason)
    guest = unpacked()
    with tempfile.TemporaryDirectory(prefix="kernel-can-") as name:
        job = Path(name)
        path = f"{os.environ['PATH']}:{guest}/usr/bin:{guest}/bin"
        lines = []
        for key, value in (os.environ | {"PATH": path}).items():
            if key.isidentifier() and key != "LD_PRELOAD":
                lines.append(f"export {key}={shlex.quote(value)}")
        lines.append(f"cd {shlex.quote(os.getcwd())}")
        lines.append(shlex.join(command))
        (job / "job.sh").write_text("\n".join(lines))
        return _boot(guest, job, timeout_s, out, err)


def _boot(guest: Path, job: Path, timeout_s: float, out, err) -> int:
    """Start the kernel, which runs the job; return the exit status of the job's command."""
    out_from, out_to = os.pipe()
    err_from, err_to = os.pipe()
    # the memory of the guest is a file, on a file system that has room for it
    memory_in = str(job)
    if shutil.disk_usage("/dev/shm").free > MEMORY_FILE_BYTES:
        memory_in = "/dev/shm"
    kernel = subprocess.Popen(
        [
            guest / "usr/bin/linux.uml",
            f"mem={MEMORY}",
            "rootfstype=hostfs",
            "rootflags=/",
            "rw",
            "quiet",
            f"init={HERE / 'init.sh'}",
            f"GUEST={guest}",
            f"JOB={job}",
            f"uml_dir={job}",
            "ssl=null",
            "con=null",
            "con0=null,fd:1",
            f"con1=null,fd:{out_to}",
            f"con2=null,fd:{err_to}",
        ],
        stdin=subprocess.DEVNULL,
        stdout=(job / "kernel.log").open("w"),
        stderr=subprocess.STDOUT,
        pass_fds=(out_to, err_to),
        start_new_session=True,
        env={"TMPDIR": memory_in, "LD_PRELOAD": str(guest / "amx.so"), "PATH": os.environ["PATH"]},
    )
    os.close(out_to)
    os.close(err_to)
    readers = [
        threading.Thread(target=_copy, args=pair) for pair in ((out_from, out), (err_from, err))
    ]
    for reader in readers:
        reader.start()
    try:
        kernel.wait(timeout_s)
    except subprocess.TimeoutExpired:
        raise GuestError(f"the command has not exited after {timeout_s:g} s") from None
    finally:
        if kernel.poll() is None:
            os.killpg(kernel.pid, signal.SIGKILL)
            kernel.wait()
        for reader in readers:
            reader.join()
    status = job / "status"
    if not status.exists():
        log = (job / "kernel.log").read_text(errors="replace")
        raise GuestError(
            f"the guest stopped before its command; the end of its log:\n{log[-3000:]}"
        )
    return int(status.read_text())


def _copy(descriptor: int, to) -> None:
    """Copy lines from the end of a pipe to a stream, until the pipe is closed."""
    with open(descriptor, encoding="utf-8", errors="replace") as source:
        for line in source:
            to.write(line)
            to.flush()


if __name__ == "__main__":
    try:
        sys.exit(run(sys.argv[1:] or ["ip", "link"]))
    except GuestError as error:
        print(f"kernel_can: {error}", file=sys.stderr)
        sys.exit(NO_GUEST)
