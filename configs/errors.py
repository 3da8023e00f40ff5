"""The family of errors that a user can correct.

A message says where, what (with value and unit), what is allowed and how to correct it. Only the
command line catches these errors; it prints the message and exits with status 2.
"""


class RollerrigError(Exception):
    """An error that a user can correct; its text says where, what, what is allowed and how."""


class ConfigError(RollerrigError):
    """A configuration file, key or value is wrong."""


class BusError(RollerrigError):
    """A bus, interface or port cannot be used."""


class PortInUseError(BusError):
    """Another program listens on the port that a server is to have."""


class UnitError(RollerrigError):
    """The WSP unit, or another external partner, did not do what the run needs."""


class InvalidRunError(RollerrigError):
    """A run is not valid, so that nothing follows from it."""


class UnitLostError(UnitError):
    """The WSP unit, or another external partner, failed in a run that had begun."""
