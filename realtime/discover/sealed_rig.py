"""A rig that hides one or two effects: a scenario whose file tells nothing, and the key that tells in plain words."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w

from rollerrig.configs import store
from rollerrig.configs.errors import ConfigError
from rollerrig.realtime.record import seal
from rollerrig.realtime.record.files import writing
from rollerrig.rig.identify.causes import table
from rollerrig.rig.mechanisms.table import BY_NAME

Sizes = Mapping[str, tuple[float, float]]
# what may be hidden, and from which size to which: two to four times what six stops are known to show (assumption).
# A first parameter that may be negative has either sign
MECHANISMS: Mapping[str, Sizes] = {
    "rail_cleaning": {"gain": (0.12, 0.25)},
    "speed_dependent_friction": {"slope_per_m_s": (0.006, 0.012)},
    "friction_trend": {"rate_1_s": (0.01, 0.02)},
    "negative_conditioning": {"loss": (0.2, 0.35)},
    "brake_gain": {"gain": (0.05, 0.1)},
    "torque_offset": {"offset_Nm": (200.0, 400.0)},
    "pad_fade": {"fade_1_MJ": (0.01, 0.03)},
    "wet_pads": {"loss": (0.1, 0.25)},
    "running_resistance": {"force_N": (600.0, 1500.0)},
    "track_gradient": {"gradient": (0.002, 0.005)},
    "roller_curvature": {"stiffness_fraction": (0.7, 1.2)},
    "interfacial_layer": {"reduction": (0.4, 0.6)},
    "falling_friction": {"fraction": (0.4, 0.8)},
    "adhesion_memory": {"length_m": (4.0, 8.0)},
    "wheel_inertia": {"fraction": (0.15, 0.3)},
    "wheel_radius": {"fraction": (0.002, 0.008)},
    "load_transfer": {"body_s2_m": (0.03, 0.06)},
    "wheel_out_of_round": {"amplitude": (0.03, 0.06)},
    "contaminated_patch": {
        "depth": (0.15, 0.3),
        "start_m": (80.0, 150.0),
        "length_m": (60.0, 120.0),
    },
    "sanding": {"gain": (0.15, 0.3), "start_s": (4.0, 7.0), "duration_s": (4.0, 8.0)},
}
# a fault of the catalogue whose doing is one of the causes
FAULTS: Mapping[str, tuple[str, Sizes]] = {
    "wheel_diameter_mismatch": ("wheel_radius", {"difference_percent": (0.3, 1.0)})
}


def drawn(seed: int, effects: int = 0) -> dict[str, Any]:
    """What a rig hides: `mechanisms`, `fault`, the `causes` that `explain` calls them, and in `words`."""
    rng = np.random.default_rng((seed, 15))
    names = list(rng.permutation([*MECHANISMS, *FAULTS]))
    found: dict[str, Any] = {"mechanisms": {}, "fault": [], "causes": [], "words": []}
    for name in names[: effects or int(rng.integers(1, 3))]:
        cause, sizes = FAULTS[name] if name in FAULTS else (str(name), MECHANISMS[name])
        row = BY_NAME[cause].parameters[0]
        values = {key: float(f"{rng.uniform(*bounds):.3g}") for key, bounds in sizes.items()}
        first = next(iter(values))
        values[first] *= rng.choice([-1.0, 1.0]) if row.low < 0.0 else 1.0
        axle = int(rng.integers(1, 5)) if table.BY_NAME[cause].single_axles_only else 0
        where = f" on wheelset {axle}" if axle else ""
        if name in FAULTS:
            found["fault"].append({"kind": name, "axle": axle} | values)
        elif cause in found["causes"]:
            continue
        else:
            found["mechanisms"] |= {f"{name}_{key}": value for key, value in values.items()}
            found["mechanisms"] |= {f"{name}_axle": float(axle)} if axle else {}
        found["causes"].append(cause)
        found["words"].append(
            f"{BY_NAME[cause].text}{where}: {name}, "
            + ", ".join(f"{key} = {value:g}" for key, value in values.items())
        )
    return found


def hide(scenario: str, seed: int, effects: int, out: Path, key: Path) -> None:
    """Write a sealed rig that starts from a scenario, and its key. Raises ConfigError."""
    if seed < 0 or not 0 <= effects <= 2:
        raise ConfigError(
            f"--seed {seed}, --effects {effects}: allowed are seeds from 0 on, and 1 or 2 effects (0: "
            "either)"
        )
    given, _ = store.load("scenarios", scenario)
    if "sealed" in given:
        raise ConfigError(
            f"{scenario} is sealed already; give the scenario that it should start from"
        )
    hidden = drawn(seed, effects)
    write(out, given, hidden)
    with writing(key):
        key.parent.mkdir(parents=True, exist_ok=True)
        key.write_text(
            f"{out.name} hides:\n" + "".join(f"- {words}\n" for words in hidden["words"]),
            encoding="utf-8",
        )


def write(out: Path, given: Mapping[str, Any], hidden: Mapping[str, Any]) -> None:
    """Write a sealed rig: a scenario as plain data, and what it hides. Raises ConfigError."""
    head = {
        "title": "A rig that hides something",
        "sealed": seal.encode(dict(hidden)).replace("\n", ""),
    }
    with writing(out):
        out.parent.mkdir(parents=True, exist_ok=True)
        out.write_text(
            "# What this rig hides stands below, encoded; its key tells. To be found out from its stops:\n"
            f"# rollerrig discover {out.name}\n" + tomli_w.dumps({**given, **head}),
            encoding="utf-8",
        )


def causes(scenario: Path) -> set[str]:
    """The causes that a sealed rig hides: for judging what was found, never for finding it. Raises ConfigError."""
    given, at = store.load("scenarios", str(scenario))
    return set(seal.decode(given.get("sealed", ""), f"{at}: sealed")["causes"])
