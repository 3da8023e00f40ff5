"""The one family of errors that a user may meet.

A message says where, what (with value and unit), what is allowed and how to mend it.
Only the command line catches them; it prints the message and leaves with status 2.
"""


class RollerrigError(Exception):
    """Something a user can mend: the text says where, what, what is allowed and how."""


class ConfigError(RollerrigError):
    """A configuration file, key or value is wrong."""


class BusError(RollerrigError):
    """A bus, interface or port cannot be used."""


class UnitError(RollerrigError):
    """The WSP unit (or another outside partner) did not do what the run needs."""
