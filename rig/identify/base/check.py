"""Runs all checks of the base on a dataset of braking runs, before any statistics."""

from collections.abc import Sequence

from rollerrig.configs.errors import ConfigError
from rollerrig.rig.identify.base import channels, reference, rolling, sampling, weight
from rollerrig.rig.identify.base.findings import Finding
from rollerrig.rig.identify.base.sentences import sentence
from rollerrig.rig.identify.data.runs import Dataset

# in the order in which a user should correct what they find
_CHECKS = (sampling.check, channels.check, rolling.check, weight.check)


class WrongBaseError(ConfigError):
    """The data have mistakes that make every conclusion worthless; `findings` has each of them."""

    def __init__(self, where: str, findings: list[Finding]) -> None:
        super().__init__("\n".join(f"{where}: {sentence(finding)}" for finding in findings))
        self.findings = tuple(findings)


def findings(data: Dataset) -> list[Finding]:
    """Return the mistakes in the runs of a dataset, in the order in which to correct them."""
    # a speed that was computed from the wheels makes the other checks compare wheels with wheels
    found = reference.check(data)
    if found:
        return found
    for one_check in _CHECKS:
        found += one_check(data)
    return found


def check(data: Dataset) -> None:
    """Raise WrongBaseError if the runs of a dataset show mistakes."""
    found = findings(data)
    if found:
        raise WrongBaseError(str(data.folder), found)


def check_order(data: Dataset, causes: Sequence[str]) -> None:
    """Raise WrongBaseError if load moves to the rear and no identified cause explains it."""
    if "load_transfer" in causes:
        return
    found = channels.check_order(data)
    if found:
        raise WrongBaseError(str(data.folder), found)
