"""`rollerrig manual`: prints the manual page, generated from the parser.

The page is in the language of man(7). Source: argparse-manpage 4.
"""

import argparse

from rollerrig.configs.errors import ConfigError
from rollerrig.realtime.commands import output


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `rollerrig manual`: none."""


def call(options: argparse.Namespace) -> int:
    """Print the manual page. Returns PASS. Raises ConfigError without argparse-manpage.

    `options.top` is the parser of the whole command line.
    """
    try:
        from argparse_manpage.manpage import Manpage
    except ImportError:
        raise ConfigError(
            "the manual page needs argparse-manpage: pip install 'rollerrig[completion]'"
        ) from None

    page = str(Manpage(options.top))
    return output.show(options, {"page": page}, page)
