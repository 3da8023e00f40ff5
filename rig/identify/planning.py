"""Proposes further stops: those in which causes that look alike here would look different.

From the whitened signatures found by trial (DISCOVERY section 3): speed and time part when stops
begin at different speeds, torque and resistance when loads and speeds differ, causes of the place
when braking begins elsewhere. Each proposal is a scenario that `rollerrig run` takes.
"""

from typing import NamedTuple


class Stop(NamedTuple):
    """One proposed stop and what it is for."""

    initial_speed_m_s: float
    pressure_Pa: float
    mass_kg: float
    reason: str


# causes that each kind of stop separates
_STOPS: tuple[tuple[frozenset[str], Stop], ...] = (
    (frozenset({"friction_trend", "speed_dependent_friction", "adhesion_memory",
                "negative_conditioning"}),
     Stop(12.0, 3.8e5, 43000.0, "low speed, long sliding: time without speed")),
    (frozenset({"friction_trend", "speed_dependent_friction", "contaminated_patch", "sanding"}),
     Stop(52.0, 3.8e5, 43000.0, "high speed: the same times and places at other speeds")),
    (frozenset({"brake_gain", "torque_offset", "pad_fade"}),
     Stop(38.0, 1.5e5, 43000.0, "half torque: a gain halves, an offset stays, heat comes late")),
    (frozenset({"running_resistance", "track_gradient", "pad_fade", "brake_gain"}),
     Stop(40.0, 0.8e5, 58000.0, "heavy and nearly coasting: resistance against gradient and torque")),
    (frozenset({"rail_cleaning", "load_transfer"}),
     Stop(35.0, 2.0e5, 43000.0, "gentle braking: loads shift less, cleaning stays")),
    (frozenset({"roller_curvature", "interfacial_layer", "falling_friction", "wheel_radius"}),
     Stop(20.0, 1.0e5, 43000.0, "micro-slip: the initial slope alone")),
    (frozenset({"speed_sensor_delay", "torque_sensor_delay", "wheel_inertia",
                "wheel_out_of_round"}),
     Stop(30.0, 4.5e5, 43000.0, "hard braking: quick valves move torque and speed most")),
)


def stops(causes: set[str], count: int) -> list[Stop]:
    """The stops that part the most of these causes first."""
    ranked = sorted(_STOPS, key=lambda row: -len(row[0] & causes))
    chosen = [row[1] for row in ranked]
    while len(chosen) < count:
        more = chosen[len(chosen) % len(ranked)]
        chosen.append(more._replace(initial_speed_m_s=0.85 * more.initial_speed_m_s))
    return chosen[:count]


def scenario(stop: Stop) -> str:
    """A stop as a scenario for `rollerrig run`."""
    return (f'title = "Proposed by explain: {stop.reason}"\n'
            'vehicle_set = "uic_z1"\nrig = "plain_track"\nadhesion = "soap"\n'
            f"initial_speed_m_s = {stop.initial_speed_m_s:.3g}\n\n"
            f"[vehicle]\nmass_kg = {stop.mass_kg:.6g}\n\n"
            f"[[demand]]\nfrom_s = 1.0\npressure_Pa = {stop.pressure_Pa:.4g}\n")
