"""The family of errors that a user can correct.

A message says where, what (with value and unit), what is allowed and how to correct it. Only the
command line catches these errors; it prints the message and exits with status 2.
"""

from collections.abc import Mapping, Sequence


class RollerrigError(Exception):
    """An error that a user can correct; its text says where, what, what is allowed and how."""


class ConfigError(RollerrigError):
    """A configuration file, key or value is wrong."""


class OtherVehicleError(ConfigError):
    """A process simulates other vehicles: those with other axles or other equipment.

    `environment` are the variables with which a process simulates this vehicle.
    """

    def __init__(self, what: str, environment: Mapping[str, str]) -> None:
        variables = " ".join(f"{name}={value}" for name, value in environment.items())
        number = "variable" if len(environment) == 1 else "variables"
        super().__init__(f"{what}; start it with the environment {number} {variables}")
        self.environment = dict(environment)


class OtherAxlesError(OtherVehicleError):
    """A vehicle has another number of axles than those that this process simulates."""

    def __init__(
        self, where: str, axles: int, simulated: int, environment: Mapping[str, str]
    ) -> None:
        what = f"{where} = {axles}: this process simulates vehicles with {simulated} axles"
        super().__init__(what, environment)
        self.axles = axles


class OtherEquipmentError(OtherVehicleError):
    """A vehicle has other equipment than those that this process simulates."""

    def __init__(
        self,
        where: str,
        equipment: Sequence[str],
        simulated: Sequence[str],
        environment: Mapping[str, str],
    ) -> None:
        what = (
            f"{where}: the vehicle has {', '.join(equipment) or 'no further equipment'}, and this "
            f"process simulates vehicles with {', '.join(simulated) or 'friction brakes only'}"
        )
        super().__init__(what, environment)


class BusError(RollerrigError):
    """A bus, interface or port cannot be used."""


class PortInUseError(BusError):
    """Another program listens on the port that a server is to have."""


class UnitError(RollerrigError):
    """The WSP unit, or another external partner, did not do what the run needs."""


class UnitLostError(UnitError):
    """The WSP unit, or another external partner, failed in a run that had begun."""
