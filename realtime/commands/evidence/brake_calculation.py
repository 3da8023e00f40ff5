"""`rollerrig brake-calculation`: the stopping distance by mean values, beside the simulated one."""

import argparse
import math
from pathlib import Path
from typing import TYPE_CHECKING

from rollerrig.configs.errors import ConfigError
from rollerrig.realtime.commands import output

if TYPE_CHECKING:
    from rollerrig.rig.brake_calculation import Stop, Vehicle

_NOTICE = (
    "By mean values after EN 14531-1, with the formulas of RailwayBrakeCalculation; the standard "
    "itself was not at hand."
)
_UNIT_HEAD = ("brake unit", "number", "force at the rail, N", "response time, s", "mass, kg")


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `rollerrig brake-calculation`."""
    parser.add_argument(
        "vehicle",
        metavar="SCENARIO",
        help="name of a packaged scenario or a TOML file: the vehicle with its largest demand; or a "
        "TOML file with [[brake_unit]]",
    )
    parser.add_argument(
        "--speed",
        type=float,
        action="append",
        default=[],
        metavar="KM_H",
        help="initial speed in km/h; may be repeated (default: that of the scenario; 120 for a file "
        "with [[brake_unit]])",
    )
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="other value of the scenario, as in vehicle.mass_kg=50000; may be repeated",
    )
    parser.add_argument(
        "--assessment",
        choices=("single", "train"),
        default="single",
        help="curves of the braked weight: of a single vehicle or of a train (default: single)",
    )


def call(options: argparse.Namespace) -> int:
    """Print the calculation of a vehicle. Raises ConfigError."""
    from rollerrig.configs import store
    from rollerrig.realtime.bench import scenario
    from rollerrig.realtime.campaign import mean_values
    from rollerrig.rig import brake_calculation

    simulated = None
    path = Path(options.vehicle)
    content = store.parse(path) if path.suffix == ".toml" and path.is_file() else {}
    if brake_calculation.BRAKE_UNIT in content:
        if options.set:
            raise ConfigError(
                f"--set is for a scenario, and {path} has brake units; change the file"
            )
        vehicle = brake_calculation.read(content, path)
        speeds_km_h = options.speed or [120.0]
    else:
        resolved = scenario.load(options.vehicle, "", tuple(options.set))
        dry = mean_values.of_scenario(resolved)
        vehicle = dry.vehicle
        simulated = (dry.speed_m_s, dry.distance_m)
        speeds_km_h = options.speed or [dry.speed_m_s * brake_calculation.KM_H]
    for speed_km_h in speeds_km_h:
        if not 1.0 <= speed_km_h <= 500.0:
            raise ConfigError(f"--speed {speed_km_h:g}: allowed are 1 to 500 km/h")

    stops = [
        brake_calculation.stop(vehicle, speed / brake_calculation.KM_H) for speed in speeds_km_h
    ]
    assessment = brake_calculation.ASSESSMENTS[options.assessment]
    percentages = brake_calculation.braked_weight_percentages(vehicle, assessment)
    least = min(percentages.values())
    lines = [
        f"braked weight ({options.assessment}): "
        + ", ".join(f"{value:.1f} % at {speed} km/h" for speed, value in percentages.items())
        + f"; {math.floor(least)} % of {vehicle.mass_kg:.0f} kg",
    ]
    result = {
        "notice": _NOTICE,
        "dynamic_mass_kg": vehicle.dynamic_mass_kg,
        "mass_kg": vehicle.mass_kg,
        "units": [unit._asdict() for unit in vehicle.units],
        "stops": [found._asdict() for found in stops],
        "braked_weight_percentage": {str(speed): value for speed, value in percentages.items()},
        "braked_weight_kg": 0.01 * least * vehicle.mass_kg,
        "simulated": None,
    }
    if simulated is not None:
        lines.append(_beside(vehicle, *simulated))
        of_calculation = brake_calculation.stop(vehicle, simulated[0])
        result["simulated"] = {
            "speed_m_s": simulated[0],
            "distance_m": simulated[1] if math.isfinite(simulated[1]) else None,
            "calculated_m": of_calculation.distance_m,
        }
    return output.show(
        options,
        result,
        ("Brake units", _UNIT_HEAD, _unit_rows(vehicle)),
        (vehicle.title or "Stops", *_stop_table(stops)),
        *lines,
        _NOTICE,
    )


def _beside(vehicle: "Vehicle", speed_m_s: float, distance_m: float) -> str:
    """Return the simulated distance beside the calculated one, in words."""
    from rollerrig.rig import brake_calculation

    if not math.isfinite(distance_m):
        return "simulated on dry rails: does not stop within 300 s"
    calculated_m = brake_calculation.stop(vehicle, speed_m_s).distance_m
    share = 100.0 * (calculated_m / distance_m - 1.0)
    speed_km_h = speed_m_s * brake_calculation.KM_H
    return (
        f"simulated on dry rails from {speed_km_h:.1f} km/h: {distance_m:.1f} m; by mean values "
        f"{calculated_m:.1f} m ({share:+.2f} %)"
    )


def _unit_rows(vehicle: "Vehicle") -> list[tuple[str, ...]]:
    return [
        (
            unit.name,
            str(unit.number),
            f"{unit.force_N:.0f}",
            f"{unit.response_s:.3f}",
            f"{unit.mass_kg:.0f}",
        )
        for unit in vehicle.units
    ]


def _stop_table(stops: "list[Stop]") -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
    """Return head and rows of a table with a column for each stop."""
    from rollerrig.rig.brake_calculation import KM_H

    quantities = (
        ("running resistance, N", [f"{found.resistance_N:.0f}" for found in stops]),
        ("response time, s", [f"{found.response_s:.3f}" for found in stops]),
        ("deceleration, m/s²", [f"{found.deceleration_m_s2:.4f}" for found in stops]),
        ("distance, m", [f"{found.distance_m:.1f}" for found in stops]),
        ("adhesion required", [f"{found.adhesion:.3f}" for found in stops]),
        ("energy, MJ", [f"{found.energy_J / 1e6:.2f}" for found in stops]),
    )
    head = ("from", *(f"{found.speed_m_s * KM_H:.1f} km/h" for found in stops))
    return head, [(name, *values) for name, values in quantities]
