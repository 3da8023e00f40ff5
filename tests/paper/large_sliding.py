"""What the end of cleaning at large sliding [A6] does, and whether it keeps the paper's recovery.

    python tests/paper/large_sliding.py

prints three tables: the six stops of `velim` with the end of cleaning of the packaged soap beside
the paper's law, the adhesion of a locked wheel over its degraded one, and the steepest fall of
adhesion with slip. Published curves for comparison of the last: the recovered curve of the paper's
Table 4, which is Polach's with a friction that falls with sliding.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from paper import velim
from rollerrig.realtime.bench import scenario
from rollerrig.rig import params as physics
from rollerrig.rig.contact import adhesion

# packaged sets on which a WSP acts
SETS = ("soap", "low", "very_low", "wet_leaves")
# the recovered curve of Table 4 on both limits: clean rail
PUBLISHED = "dry"
SPEEDS_M_S = (2.0, 5.0, 10.0, 15.0, 20.0, 30.0, 44.0)
LOCKED_SPEEDS_M_S = (10.0, 20.0, 30.0, 44.0)
SLIPS = np.linspace(0.002, 1.0, 500)
WHEEL_LOAD_N = 52.7e3

# requirements: deceleration in the second half over that by the paper's law; a locked wheel's
# adhesion over its degraded one
LEAST_RECOVERY = 0.9
MOST_WHEN_LOCKED = 1.1


class Recovery(NamedTuple):
    """Decelerations of a stop from 20 to 10 m/s, in m/s2."""

    paper_m_s2: float
    packaged_m_s2: float

    @property
    def ratio(self) -> float:
        """The packaged law over the paper's."""
        return self.packaged_m_s2 / self.paper_m_s2


def recovery(tests: Sequence[str] = velim.TESTS) -> dict[str, Recovery]:
    """Run stops of the paper by both laws."""
    found = velim.settings()
    law = velim.packaged_law()
    result = {}
    for test in tests:
        paper = velim.stop(test, found).decelerations_m_s2[1]
        packaged = velim.stop(test, found, *law).decelerations_m_s2[1]
        result[test] = Recovery(paper, packaged)
    return result


def params_of(adhesion_set: str) -> physics.Params:
    """Return the parameters of a coach on a rail with a packaged set."""
    settings = ("rig=plain_track", f"adhesion={adhesion_set}")
    return scenario.load("velim_a1", settings=settings).params


def wheel(params: physics.Params, slip: float, speed_m_s: float) -> tuple[float, float]:
    """Return the adhesion of one wheel in steady slip, and its degraded adhesion."""
    f, degraded, *_ = adhesion.wheel_adhesion(
        slip * speed_m_s, speed_m_s, WHEEL_LOAD_N, params.patch, params.law
    )
    return f, degraded


def locked_over_degraded(adhesion_set: str, speed_m_s: float) -> float:
    """Return the adhesion of a locked wheel over the degraded adhesion at that sliding."""
    f, degraded = wheel(params_of(adhesion_set), 1.0, speed_m_s)
    return f / degraded


def steepest_fall(adhesion_set: str, speed_m_s: float) -> tuple[float, float]:
    """Return the largest -df / dslip at a speed, and the slip where it is."""
    params = params_of(adhesion_set)
    f = np.array([wheel(params, slip, speed_m_s)[0] for slip in SLIPS])
    fall = -np.diff(f) / np.diff(SLIPS)
    return float(fall.max()), float(SLIPS[fall.argmax()])


def steepest_published(speeds_m_s: Sequence[float] = SPEEDS_M_S) -> float:
    """Return the largest fall of the recovered curve of Table 4 at these speeds."""
    return max(steepest_fall(PUBLISHED, speed)[0] for speed in speeds_m_s)


def _show(found: Mapping[str, Recovery]) -> None:
    print("deceleration 20 to 10 m/s, m/s2: paper's law, packaged soap, ratio")
    for test, one in found.items():
        print(f"  {test.upper()}  {one.paper_m_s2:.2f}  {one.packaged_m_s2:.2f}  {one.ratio:.3f}")
    print("adhesion of a locked wheel over its degraded one")
    for name in SETS:
        ratios = (f"{locked_over_degraded(name, speed):.3f}" for speed in LOCKED_SPEEDS_M_S)
        print(f"  {name:10}  {'  '.join(ratios)}   at {LOCKED_SPEEDS_M_S} m/s")
    print(f"steepest fall of adhesion per unit of slip (and its slip) at {SPEEDS_M_S} m/s")
    for name in (*SETS, PUBLISHED):
        falls = (steepest_fall(name, speed) for speed in SPEEDS_M_S)
        print(f"  {name:10}  {'  '.join(f'{fall:.2f} ({at:.0%})' for fall, at in falls)}")


if __name__ == "__main__":
    _show(recovery())
