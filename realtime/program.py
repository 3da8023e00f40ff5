"""The program `rollerrig`: checks the limit of its memory, and then starts the command line.

Libraries that the command line imports need address space. Where a limit leaves too little, they
end the process with a traceback, or with a signal that Python cannot handle.
"""

import resource
import sys

# measured on two cores: a run, its recorder and their libraries
LEAST_ADDRESS_SPACE = 1_500_000_000
_USAGE = 2  # exit status, see `cli`


def main() -> int:
    """Run the command line and return its exit status."""
    limit, _ = resource.getrlimit(resource.RLIMIT_AS)
    if limit != resource.RLIM_INFINITY and limit < LEAST_ADDRESS_SPACE:
        print(
            f"rollerrig: a limit of this shell leaves {limit / 1e6:.0f} MB of memory, and at least "
            f"{LEAST_ADDRESS_SPACE / 1e6:.0f} MB are needed; allow more: ulimit -v unlimited",
            file=sys.stderr,
        )
        return _USAGE

    # not before the check
    from rollerrig.realtime import cli

    return cli.main()
