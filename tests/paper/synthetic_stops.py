"""Makes the synthetic dataset of the six Velim stops: simulated by this project, seen by sensors.

`configs/datasets/velim_synthetic` is such a dataset, made with the reference unit and the fit of an
earlier version.
"""

from pathlib import Path

import numpy as np

from paper import velim
from rollerrig.realtime.bench import free
from rollerrig.realtime.datasets import run_dataset, run_sensors
from rollerrig.rig.identify.data.runs import Run
from rollerrig.wsp_interface import signals


def run_of(name: str, group: str, mass_kg: float, rows: np.ndarray) -> Run:
    """Return a run, as the physics computed it; `rows`: rows of all signals, (n, signals.WIDTH)."""
    return Run(
        name=name,
        group=group,
        mass_kg=mass_kg,
        mu_cd=None,
        time_s=rows[:, signals.column("time")],
        speed_m_s=rows[:, signals.column("vehicle_speed")],
        wheel_speed_rad_s=rows[:, velim.TABLE.span("wheel_speed")],
        load_N=rows[:, velim.TABLE.span("wheel_load")],
        torque_Nm=rows[:, velim.TABLE.span("brake_torque")],
        position_m=None,
        surface_m_s=None,
    )


def write(out: Path, seed: int = 1) -> Path:
    """Write the dataset, down to `run_dataset.SLOWEST_M_S`; return its folder.

    `seed` decides the noise of the sensors. Raises ConfigError where the folder cannot be written.
    """
    found = velim.settings()
    rng = np.random.default_rng(seed)

    resolved = velim.plan_of("a1", found).resolved
    # the contaminant differs between the tests, so the dataset gives none
    adhesion = {key: value for key, value in resolved["adhesion"].items() if key != "mu_cd"}
    resolved = resolved | {"adhesion": adhesion}

    simulated = []
    for test in velim.TESTS:
        group = "tune" if test in velim.GROUP_A else "validate"
        rows = free.moving(velim.rows_of(test, found), run_dataset.SLOWEST_M_S)
        simulated.append(run_of(test, group, resolved["vehicle"]["mass_kg"], rows))
    return run_dataset.write(
        out,
        [run_sensors.noisy(run, run_sensors.TRAIN, rng) for run in simulated],
        resolved,
        run_sensors.TRAIN,
        rounded=True,
        title="SYNTHETIC: six stops as at Velim, simulated by this project; not the recordings "
        "of the paper",
        source="rollerrig tune velim --synthetic; true tau 1.9e-4 m/J",
    )
