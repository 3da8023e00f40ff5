"""A plant alone, advanced tick by tick, with the state of every tick recorded: no bus, no clock."""

import numpy as np

from rollerrig.firmware_sim import rig_control
from rollerrig.rig import params, plant
from rollerrig.rig.compiled.kernel import kernel_with_memory
from rollerrig.rig.state import NAMES, slots
from rollerrig.wsp_interface.magnets import FILLING, HOLDING, VENTING

# patterns of the valve magnets
FILL = FILLING
HOLD = HOLDING
VENT = VENTING

FULL_BRAKE_PA = 3.8e5
# Values of configs/adhesion/soap.toml, leaf_film.toml and dry.toml. They are repeated here because
# the tests must hold when those files change.
SOAP = {"cleaning_creepage": 0.55, "cleaning_sliding_m_s": 8.1}
LEAVES = SOAP | {
    "mu_cd": 0.02,
    "mu_cr": 0.20,
    "A_d": 0.5,
    "gamma_d_s_m": 0.1,
    "k_ad": 0.2,
    "tau_m_J": 6.0e-5,
}
# slots that are logged; the constants of the axles follow them
LOGGED = NAMES[: NAMES.index("on_track")]
DRY = {"mu_cd": 0.28, "gamma_d_s_m": 0.6, "k_ad": 1.0, "k_sd": 0.4, "tau_m_J": 0.0}
TRACK = {"mode": "track"}
NO_RESISTANCE = {"resistance_A_N": 0.0, "resistance_B_N_s_m": 0.0, "resistance_C_N_s2_m2": 0.0}


@kernel_with_memory
def _roll(state, buffer, kept, delay, magnets, demand_Pa, first_tick, controlled, params, log):
    for i in range(log.shape[0]):
        if controlled:
            rig_control.hold_surface_speed(state, params.drive, params.tick_s)
        plant.advance(state, delay, magnets[i], demand_Pa, first_tick + i, params)
        plant.observe(state, params)
        for k in range(kept.size):
            log[i, k] = buffer[kept[k]]


class History:
    """The states of a number of ticks; the first one is the state before them.

    Each slot of the state is an attribute: `history.wheel_speed` has shape (n, axles).
    """

    def __init__(self, log, axles):
        self.log = log
        self.axles = axles

    def __getattr__(self, name):
        if name not in LOGGED:
            raise AttributeError(name)
        begin = 0
        places = slots(self.axles)
        for slot in LOGGED:
            end = begin + places[slot].stop - places[slot].start
            if slot == name:
                break
            begin = end
        values = self.log[:, begin:end]
        if values.shape[1] == 1:
            return values[:, 0]
        return values

    def change(self, name):
        """Return the change of a slot from the first to the last state."""
        values = getattr(self, name)
        return values[-1] - values[0]

    def integral(self, rate):
        """Return the trapezoidal integral over time of a rate (n, ...), in its unit times s."""
        mean = 0.5 * (rate[1:] + rate[:-1])
        return np.sum(mean.T * np.diff(self.time), axis=-1)

    @property
    def contact_force_N(self):
        """Return the contact force f N of each axle, shape (n, 4)."""
        return self.adhesion * self.wheel_load


def _friction_plan(changes):
    """Return the changes of friction, rows as in `Rig`, as the plant reads them."""
    columns = list(zip(*changes, strict=True))
    if not columns:
        columns = [()] * len(params.Friction._fields)
    types = (np.bool_, np.float64, np.float64, np.float64, np.int64)
    arrays = [np.array(column, kind) for column, kind in zip(columns, types, strict=True)]
    return params.Friction(*arrays)


class Rig:
    """A rig that rolls. `sections` override single parameters: vehicle={"mass_kg": 1e4}.

    `friction` rows are (by_place, start, mu_cd, mu_cr, mask of axles).
    """

    def __init__(self, speed_m_s=30.0, step_s=1e-4, tick_s=1e-3, friction=(), **sections):
        checked = params.check(sections, "a test")
        full_brake = params.Demand(np.zeros(1), np.array([FULL_BRAKE_PA]))
        steps_per_tick = round(tick_s / step_s)
        self.params = params.build(
            checked, _friction_plan(friction), full_brake, tick_s, steps_per_tick
        )
        self.plant = plant.Plant(self.params, speed_m_s)
        self.state = self.plant.state
        self.tick = 0

    def charge(self, pressure_Pa):
        """Set the brake demand and the pressure of all cylinders."""
        self.state.brake_demand[:] = pressure_Pa
        self.state.cylinder_pressure[:] = pressure_Pa

    def roll(self, seconds, magnets=FILL, demand_Pa=np.nan, controlled=True):
        """Advance the rig and return the `History`. Without rig control the motors are idle.

        `magnets` is a pattern for all axles, one for each axle, or a row for each tick.
        `demand_Pa` is the demanded pressure, NaN for full brake.
        """
        ticks = round(seconds / self.params.tick_s)
        # the buffer has room for more axles
        places = slots(self.params.axles)
        kept = np.concatenate([np.r_[places[name]] for name in LOGGED])
        log = np.empty((ticks + 1, kept.size))
        log[0] = self.plant.buffer[kept]
        energised = np.empty((ticks, self.params.axles))
        energised[:] = magnets
        on_rollers = self.params.mode != params.TRACK
        _roll(
            self.state,
            self.plant.buffer,
            kept,
            self.plant.delay,
            energised,
            float(demand_Pa),
            self.tick,
            controlled and on_rollers,
            self.params,
            log[1:],
        )
        self.tick += ticks
        return History(log, self.params.axles)
