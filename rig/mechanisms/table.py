"""The effects that the base model leaves out: all mechanisms, one row each.

Each mechanism changes one place of the base model. Its size is a coefficient, and with its default
0 the model is the base model, to the last bit. The same rows provide the bounds of the
identification, the keys of the extended model and the words of the report. A new mechanism needs a
formula and a row in `friction`, `torque`, `constants` or `elsewhere`, and one row in
`identify.causes.table`.

    friction:  mu_cd and mu_cr of an axle are multiplied by exp(sum of coefficient x course)   [X1]
    torque:    C times (1 + coefficient x course), or plus coefficient x course                [X2]
    vehicle:   M dv/dt = -sum T - (R + dR + M g gradient)                                      [X3]
    contact:   d lambda/dx = (lambda_0 - lambda) / L, lambda_0 of the base model               [X4]

Limit: the shapes are the simplest ones, without further justification.
"""

from rollerrig.configs.table import Row
from rollerrig.configs.vehicle import AXLES_OF_BOGIE, MOST_AXLES
from rollerrig.rig.mechanisms import constants, elsewhere, friction, torque
from rollerrig.rig.mechanisms.mechanism import AXLE, SENSOR, Mechanism

TABLE: tuple[Mechanism, ...] = (*friction.ROWS, *torque.ROWS, *constants.ROWS, *elsewhere.ROWS)
BY_NAME: dict[str, Mechanism] = {
    mechanism.name: mechanism for mechanism in (*TABLE, friction.EMPIRICAL)
}
# the effect of a sensor is in the recording; all other mechanisms are in the plant
IN_PLANT = tuple(m for m in BY_NAME.values() if m.acts_on != SENSOR)


def rows(axles: int = MOST_AXLES) -> tuple[Row, ...]:
    """Return the rows of the section [mechanisms] of a model: `<mechanism>_<parameter>`.

    The place of a mechanism is an axle or bogie of a vehicle with so many axles.
    """
    found = []
    for mechanism in IN_PLANT:
        for row in mechanism.parameters:
            low, high = row.low, row.high
            if row.name == AXLE.name:
                low, high = -float(axles // AXLES_OF_BOGIE), float(axles)
            name = f"{mechanism.name}_{row.name}"
            found.append(row._replace(name=name, low=low, high=high))
    return tuple(found)
