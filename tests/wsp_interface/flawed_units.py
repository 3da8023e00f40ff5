"""The reference WSP unit, and ten units with one flaw each, for the bench in memory.

A flaw is a wrong parameter, or a change of what the reference unit gets or answers. Each is a flaw
that a person would find in a unit under test.
"""

from collections import deque

import numpy as np

from rollerrig.firmware_sim.wsp import logic
from rollerrig.wsp_interface import magnets
from rollerrig.wsp_interface.magnets import FILLING, HOLDING, VENTING

CYCLE_S = 0.01
TOO_LATE_S = 0.8
SWING_S = 0.3  # half a period
DRIFT_M_S2 = 1.6
WRONG_DIAMETER = 1.25
TWENTY_KM_H = 20.0 / 3.6
# permitted shares of a motor
ALL, NONE = 1.0, 0.0


def acts(pairs, shares):
    """Return whether a unit vents a valve or releases a motor."""
    return VENTING in pairs or min(shares) < ALL


def swapped(values):
    """Return the values of the axles with those of the first and last axle exchanged."""
    return [values[-1], *values[1:-1], values[0]]


class Unit:
    """The reference unit of a group of axles, with the parameters of a vehicle."""

    def __init__(self, params, axles):
        self.params = params
        self.axles = axles
        self._unit = logic.new_unit(params, axles)

    def cycle(self, counts):
        """Return the byte of magnets, the reference speed in counts, and the shares of motors."""
        byte, reference = logic.cycle(self._unit, counts)
        shares = [logic.permitted_share(self._unit, axle) for axle in range(self.axles)]
        pairs, shares = self.answer(magnets.unpack(int(byte), self.axles), shares)
        return magnets.pack(pairs), reference, shares

    def answer(self, pairs, shares):
        """Return the pairs of magnets and the shares of the motors that the unit commands."""
        return pairs, shares


class TooSlow(Unit):
    """Commands its magnets 0.8 s late."""

    def __init__(self, params, axles):
        super().__init__(params, axles)
        cycles = round(TOO_LATE_S / CYCLE_S)
        self._late = deque([([FILLING] * axles, [ALL] * axles)] * cycles)

    def answer(self, pairs, shares):
        self._late.append((pairs, shares))
        return self._late.popleft()


class BandTooWide(Unit):
    """Lets wheels slide by up to nine tenths of the speed."""

    def __init__(self, params, axles):
        wide = {
            "band_low_m_s": 20.0,
            "band_low_fraction": 0.8,
            "band_high_m_s": 20.0,
            "band_high_fraction": 0.9,
            "deep_factor": 1.0,
        }
        super().__init__(params._replace(**wide), axles)

    def answer(self, pairs, shares):
        # motors are released when the valves are, and not at the first sliding
        return pairs, [ALL if pair == FILLING else NONE for pair in pairs]


class OneAxleOnly(Unit):
    """Protects the leading axle only."""

    def answer(self, pairs, shares):
        others = self.axles - 1
        return [pairs[0], *[FILLING] * others], [shares[0], *[ALL] * others]


class WrongDiameter(Unit):
    """Believes that the leading wheelset is a quarter larger than it is."""

    def __init__(self, params, axles):
        diameters_m = list(params.wheel_diameter_m)
        diameters_m[0] *= WRONG_DIAMETER
        super().__init__(params._replace(wheel_diameter_m=tuple(diameters_m)), axles)


class DriftingReference(Unit):
    """From the first sliding on, its reference speed falls at 1.6 m/s2, whatever the wheels do."""

    def __init__(self, params, axles):
        # a rising wheel does not lift the reference either
        super().__init__(params._replace(reference_rise_m_s2=0.5), axles)
        self._drifted_m_s = None

    def answer(self, pairs, shares):
        reference_m_s = self._unit.state.reference_m_s
        if self._drifted_m_s is None and acts(pairs, shares):
            self._drifted_m_s = reference_m_s[0]
        if self._drifted_m_s is not None:
            self._drifted_m_s = max(self._drifted_m_s - DRIFT_M_S2 * CYCLE_S, 0.0)
            reference_m_s[0] = self._drifted_m_s
        return pairs, shares


class NeverRefills(Unit):
    """Holds for ever what a valve has vented, and permits no motor again that it has released."""

    def __init__(self, params, axles):
        super().__init__(params, axles)
        self._vented = [False] * axles
        self._released = [False] * axles

    def answer(self, pairs, shares):
        answered = []
        for axle, pair in enumerate(pairs):
            self._vented[axle] |= pair == VENTING
            self._released[axle] |= shares[axle] < ALL
            holds = self._vented[axle] and pair == FILLING
            answered.append(HOLDING if holds else pair)
        return answered, [NONE if released else ALL for released in self._released]


class AlwaysVents(Unit):
    """Vents every axle from the first sliding on."""

    def __init__(self, params, axles):
        super().__init__(params, axles)
        self._slid = False

    def answer(self, pairs, shares):
        self._slid |= acts(pairs, shares)
        pair, share = (VENTING, NONE) if self._slid else (FILLING, ALL)
        return [pair] * self.axles, [share] * self.axles


class DeadWhenSlow(Unit):
    """Does not act below 20 km/h."""

    def __init__(self, params, axles):
        super().__init__(params._replace(cut_off_m_s=TWENTY_KM_H), axles)

    def answer(self, pairs, shares):
        slow = self._unit.state.reference_m_s[0] < TWENTY_KM_H
        return pairs, [ALL] * self.axles if slow else shares


class SwappedAxles(Unit):
    """Its valves are wired to the wrong axles: the first and last of its group are swapped."""

    def answer(self, pairs, shares):
        return swapped(pairs), swapped(shares)


class Oscillating(Unit):
    """From the first sliding on, vents and fills all axles in turn, whatever the wheels do."""

    def __init__(self, params, axles):
        super().__init__(params, axles)
        self._cycles = 0

    def answer(self, pairs, shares):
        if self._cycles or acts(pairs, shares):
            self._cycles += 1
        vents = self._cycles and int(self._cycles * CYCLE_S / SWING_S) % 2 == 0
        pair, share = (VENTING, NONE) if vents else (FILLING, ALL)
        return [pair] * self.axles, [share] * self.axles


FLAWED = (
    TooSlow,
    BandTooWide,
    OneAxleOnly,
    WrongDiameter,
    DriftingReference,
    NeverRefills,
    AlwaysVents,
    DeadWhenSlow,
    SwappedAxles,
    Oscillating,
)


def of(kind_of_unit, wsp_config):
    """Return what makes a unit of this kind for a number of axles, configured for a vehicle."""
    params = logic.load(wsp_config)
    return lambda axles: kind_of_unit(params, axles)


def warm():
    """Compile the cycle, or load it from the cache of numba."""
    logic.cycle(logic.new_unit(logic.load(), 4), np.zeros(4, dtype=np.int64))
