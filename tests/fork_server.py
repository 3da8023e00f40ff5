"""Forks Python programs from a process that has loaded rollerrig: `python fork_server.py SOCKET`.

A forked program does not differ from a program that is started by hand, but it costs a tenth of the
processor time. The server has no threads, and no bench runs in it. It serves one process of tests
(see `program.py`) and exits with it.
"""

import array
import contextlib
import json
import os
import runpy
import selectors
import signal
import socket
import sys

LONGEST_REQUEST = 1 << 20  # bytes
# of a request: standard input, output and error of the program, and a pipe for what becomes of it
DESCRIPTORS = 4


def main():
    """Serve; a forked program returns from that with its request, and runs."""
    channel = socket.socket(fileno=int(sys.argv[1]))
    del sys.path[0]  # the folder of this file is not in the path of a program
    load()
    request = serve(channel)
    if request:
        run(request)


def load():
    """Load what commands import, and the kernels of a bench."""
    import pyarrow.parquet  # noqa: F401

    from rollerrig.realtime import cli  # noqa: F401
    from rollerrig.realtime.bench import bench, free, scenario, tick_data  # noqa: F401
    from rollerrig.realtime.campaign import campaign  # noqa: F401
    from rollerrig.realtime.loop import ring
    from rollerrig.realtime.record import summary  # noqa: F401

    plan = scenario.load("velim_a1", settings=("duration_max_s=0.1",))
    for pacing in ("wall", "lockstep"):
        memory = ring.Memory(1000, plan.table)
        tick_data.warm_up(tick_data.build(plan, memory), pacing, "external")
    free.simulate(plan)


def serve(channel):
    """Fork a program for each request.

    Returns the request in the forked program, and None when the process of tests is gone.
    """
    exits, write_end = os.pipe()
    os.set_blocking(write_end, False)
    default_handler = signal.signal(signal.SIGCHLD, lambda number, frame: None)
    signal.set_wakeup_fd(write_end)
    replies = {}
    with selectors.DefaultSelector() as selector:
        selector.register(channel, selectors.EVENT_READ)
        selector.register(exits, selectors.EVENT_READ)
        while True:
            ready = [key.fileobj for key, _ in selector.select()]
            if exits in ready:
                os.read(exits, 4096)
                report_exits(replies)
            if channel not in ready:
                continue
            message, descriptors = receive(channel)
            if not message:
                return None
            *streams, reply = descriptors
            pid = os.fork()
            if pid:
                replies[pid] = reply
                os.write(reply, f"{pid}\n".encode())
                close(streams)
                continue
            signal.set_wakeup_fd(-1)
            signal.signal(signal.SIGCHLD, default_handler)
            channel.close()
            close((exits, write_end, reply, *replies.values()))
            connect(streams)
            return json.loads(message)


def receive(channel):
    """Return a request and its descriptors; an empty request if nobody sends another one."""
    message, ancillary, _, _ = channel.recvmsg(
        LONGEST_REQUEST, socket.CMSG_SPACE(DESCRIPTORS * array.array("i").itemsize)
    )
    descriptors = array.array("i")
    for _, _, data in ancillary:
        descriptors.frombytes(data)
    return message, descriptors


def close(descriptors):
    for descriptor in descriptors:
        os.close(descriptor)


def connect(streams):
    """Make these descriptors standard input, output and error."""
    for number, stream in enumerate(streams):
        os.dup2(stream, number)
    close(streams)


def report_exits(replies):
    """Write the exit status of each program that has exited into its pipe."""
    with contextlib.suppress(ChildProcessError):
        while True:
            pid, status = os.waitpid(-1, os.WNOHANG)
            if not pid:
                return
            reply = replies.pop(pid)
            with contextlib.suppress(BrokenPipeError):
                os.write(reply, f"{os.waitstatus_to_exitcode(status)}\n".encode())
            os.close(reply)


def run(request):
    """Run the program in this process, as `python -m MODULE` or `python -c TEXT` does."""
    from rollerrig.configs.processes import parent_death

    os.setsid()
    parent_death.signal_at_parent_death(os.getppid(), signal.SIGTERM)
    os.chdir(request["folder"])
    os.sched_setaffinity(0, request["cores"])
    for number in request["ignored"]:
        signal.signal(number, signal.SIG_IGN)
    os.environ.clear()
    os.environ.update(request["environment"])

    option, program, *words = request["words"]
    sys.argv = [option, *words]
    sys.orig_argv = [sys.executable, *request["words"]]
    if option == "-m":
        sys.modules.pop(program, None)  # it becomes the module "__main__"
        runpy._run_module_as_main(program)
    else:
        exec(program, {"__name__": "__main__"})


if __name__ == "__main__":
    main()
