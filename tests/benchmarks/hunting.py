"""The critical speed of the coach in 3D: a sweep over speeds, on the track and on dry and degraded rails.

All wheelsets are set half a millimetre off the middle, and the swing is watched for four seconds: it dies away below
the critical speed and grows above. Dampers, bump-stops and traction rods are assumed curves (`[multibody]`), so this
speed is theirs as much as the paper's; `--set multibody.laying=0.025` or `multibody.yaw_damper_N_s_m=0` move it.
"""

import argparse
import math

import numpy as np
from rich.table import Table

from rollerrig.realtime.bench import scenario
from rollerrig.realtime.benchmarks import figures
from rollerrig.realtime.benchmarks.figures import Result, Say
from rollerrig.rig import params
from rollerrig.rig.contact.creep_force import MODELS
from rollerrig.rig.multibody import coach, stability

SPEEDS_M_S = tuple(float(speed) for speed in np.arange(20.0, 141.0, 10.0))
RAILS = ("dry", "soap")
_TOLERANCE_M_S = 0.5


def run(given: argparse.Namespace, say: Say) -> Result:
    """Growth of a swing in 1/s at each speed, and the critical speed in m/s (None: none)."""
    sweeps: dict[str, list[float]] = {}
    critical: dict[str, float | None] = {}
    for rail in RAILS:
        settings = ("rig=plain_track", f"adhesion={rail}", *given.set)
        sections = params.check(scenario.load("velim_a1", settings=settings).resolved, "velim_a1")
        law = params.law_of(sections["adhesion"])
        one = coach.build(
            sections,
            math.inf,
            MODELS[sections["contact"]["model"]],
            sections["contact"]["fastsim_cells"],
        )
        sweeps[rail] = []
        for speed in SPEEDS_M_S:
            sweeps[rail].append(stability.growth(one, law, speed))
            say(
                f"{rail}: {speed:5.0f} m/s ({3.6 * speed:.0f} km/h)  growth {sweeps[rail][-1]:.3f} 1/s"
            )
        unstable = [
            speed for speed, growth in zip(SPEEDS_M_S, sweeps[rail], strict=True) if growth > 0.0
        ]
        # the first speed at which a swing grows
        critical[rail] = (
            stability.critical_speed(
                one, law, np.array([max(unstable[0] - 10.0, 1.0), unstable[0]]), _TOLERANCE_M_S
            )
            if unstable
            else None
        )
    return {
        "speeds_m_s": list(SPEEDS_M_S),
        "growth_1_s": sweeps,
        "critical_speed_m_s": critical,
        "notes": [
            *(
                f"{rail}: no hunting up to {SPEEDS_M_S[-1]:.0f} m/s"
                if speed is None
                else f"{rail}: hunting from {speed:.1f} m/s ({3.6 * speed:.0f} km/h) on"
                for rail, speed in critical.items()
            ),
            "dampers, bump-stops and traction rods are assumed curves: so is this speed",
        ],
    }


def table(result: Result) -> Table:
    """The sweep: how fast a lateral swing grows (above 0) or dies away."""
    rows = [
        (speed, 3.6 * speed, *(result["growth_1_s"][rail][i] for rail in RAILS))
        for i, speed in enumerate(result["speeds_m_s"])
    ]
    return figures.table(
        "growth of a lateral swing of the coach, 1/s", ("m/s", "km/h", *RAILS), rows
    )
