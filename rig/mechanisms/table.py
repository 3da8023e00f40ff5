"""What the base model leaves out: all mechanisms, one row each, one coefficient a parameter.

Each mechanism changes one place of the base model. Its size is a coefficient whose default 0 is the base
model itself, to the last bit. The same rows give the identification its bounds, the extended model its
keys and the report its words. To add one: its formula and its row in `friction`, `torque`, `constants`
or `elsewhere`, and one row in `identify.causes.table`.

    friction:  mu_cd and mu_cr of an axle are multiplied by exp(sum of coefficient x course)      [X1]
    torque:    C times (1 + coefficient x course), or plus coefficient x course                   [X2]
    vehicle:   M dv/dt = -sum T - (R + dR + M g gradient)                                         [X3]
    contact:   d lambda/dx = (lambda_0 - lambda) / L, lambda_0 of the base model                  [X4]

Doubt: the shapes are the simplest ones.
"""

from rollerrig.configs.table import Row
from rollerrig.configs.vehicle import AXLES
from rollerrig.rig.mechanisms import constants, elsewhere, friction, torque
from rollerrig.rig.mechanisms.mechanism import SENSOR, Mechanism

TABLE: tuple[Mechanism, ...] = (*friction.ROWS, *torque.ROWS, *constants.ROWS, *elsewhere.ROWS)
BY_NAME: dict[str, Mechanism] = {
    mechanism.name: mechanism for mechanism in (*TABLE, friction.EMPIRICAL)
}
# what a sensor does to the truth lies in the recording; all else is in the plant
IN_PLANT = tuple(m for m in BY_NAME.values() if m.acts_on != SENSOR)


def rows() -> tuple[Row, ...]:
    """Rows of the section [mechanisms] of a model: `<mechanism>_<parameter>`, default 0."""
    return tuple(
        row._replace(name=f"{m.name}_{row.name}", high=AXLES if row.name == "axle" else row.high)
        for m in IN_PLANT
        for row in m.parameters
    )
