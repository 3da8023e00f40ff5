"""Runs all checks of the base on a dataset of braking runs, before any statistics."""

from collections.abc import Sequence

from rollerrig.configs.errors import ConfigError
from rollerrig.rig.identify.base import channels, reference, rolling, sampling, shared, weight
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
    return [_with_shared(data, finding) for finding in found]


def _with_shared(data: Dataset, finding: Finding) -> Finding:
    """Return a finding with what its runs share."""
    apart = [k for k, run in enumerate(data.runs) if run.name in finding.runs]
    others = [k for k, run in enumerate(data.runs) if run.name not in finding.runs]
    return finding._replace(shared=shared.find(data.runs, apart, others))


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
