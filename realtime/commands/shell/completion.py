"""`rollerrig completion`: prints the lines that make a shell complete command lines of rollerrig.

The lines are made by argcomplete. They call the program, so that what it completes is always what
its parser takes: verbs, options and the choices of options.
"""

import argparse
import sys

from rollerrig.configs.errors import ConfigError
from rollerrig.realtime.commands import output

# where each shell looks for the completion of a program, as a hint
PLACES = {
    "bash": "~/.local/share/bash-completion/completions/rollerrig",
    "zsh": "a folder of $fpath, as _rollerrig",
    "fish": "~/.config/fish/completions/rollerrig.fish",
}


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `rollerrig completion`."""
    parser.add_argument("shell", choices=tuple(PLACES), help="the shell that completes")


def call(options: argparse.Namespace) -> int:
    """Print the lines for a shell. Returns PASS. Raises ConfigError without argcomplete."""
    try:
        import argcomplete
    except ImportError:
        raise ConfigError(
            "completion needs argcomplete: pip install 'rollerrig[completion]'"
        ) from None

    lines = argcomplete.shellcode(["rollerrig"], True, options.shell)
    if not options.json and sys.stdout.isatty():
        output.print_message(f"write these lines to {PLACES[options.shell]}, and open a new shell:")
    return output.show(
        options, {"shell": options.shell, "place": PLACES[options.shell], "lines": lines}, lines
    )
