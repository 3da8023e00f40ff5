"""A rig that hides one or two effects: a scenario that does not show them, and a key in words."""

import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import tomli_w

from rollerrig.configs import store
from rollerrig.configs.errors import ConfigError
from rollerrig.configs.output_files import make_folder, write_text, writing
from rollerrig.realtime.record import seal
from rollerrig.rig.identify.causes import table
from rollerrig.rig.mechanisms.table import BY_NAME

# the least and the largest value of each parameter of an effect
Sizes = Mapping[str, tuple[float, float]]
# The mechanisms that may be hidden. The sizes are two to four times those that six stops are known
# to show (assumption). If the first parameter may be negative, its sign is drawn.
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
# faults of the catalogue that may be hidden: the cause that has the same effect, and the sizes
FAULTS: Mapping[str, tuple[str, Sizes]] = {
    "wheel_diameter_mismatch": ("wheel_radius", {"difference_percent": (0.3, 1.0)})
}


class _Effect(NamedTuple):
    """A drawn effect: a mechanism or a fault by name, with the values of its parameters."""

    name: str
    cause: str
    axle: int  # 0: all axles
    values: dict[str, float]

    @property
    def words(self) -> str:
        """A description for the key."""
        where = f" on wheelset {self.axle}" if self.axle else ""
        values = ", ".join(f"{key} = {value:g}" for key, value in self.values.items())
        return f"{BY_NAME[self.cause].text}{where}: {self.name}, {values}"


def draw(seed: int, effects: int = 0) -> dict[str, Any]:
    """Return the hidden content of a rig, with one or two effects (0: either).

    It holds `mechanisms` and `fault` as in a scenario, the `causes` by which `explain` calls the
    effects, and a description of each effect in `words`.
    """
    rng = np.random.default_rng((seed, 15))
    names = list(rng.permutation([*MECHANISMS, *FAULTS]))
    count = effects or int(rng.integers(1, 3))

    hidden: dict[str, Any] = {"mechanisms": {}, "fault": [], "causes": [], "words": []}
    for name in names[:count]:
        effect = _draw_effect(name, rng)
        if name in FAULTS:
            fault = {"kind": name, "axle": effect.axle} | effect.values
            hidden["fault"].append(fault)
        elif effect.cause in hidden["causes"]:
            # a fault with the same effect is already hidden
            continue
        else:
            for key, value in effect.values.items():
                hidden["mechanisms"][f"{name}_{key}"] = value
            if effect.axle:
                hidden["mechanisms"][f"{name}_axle"] = float(effect.axle)
        hidden["causes"].append(effect.cause)
        hidden["words"].append(effect.words)
    return hidden


def _draw_effect(name: str, rng: np.random.Generator) -> _Effect:
    """Return an effect with drawn values; the order of the draws decides what a seed hides."""
    if name in FAULTS:
        cause, sizes = FAULTS[name]
    else:
        cause = str(name)
        sizes = MECHANISMS[name]
    values = {key: float(f"{rng.uniform(*bounds):.3g}") for key, bounds in sizes.items()}
    if BY_NAME[cause].parameters[0].low < 0.0:
        first = next(iter(values))
        values[first] *= rng.choice([-1.0, 1.0])
    axle = 0
    if table.BY_NAME[cause].single_axles_only:
        axle = int(rng.integers(1, 5))
    return _Effect(name, cause, axle, values)


def hide(scenario: str, seed: int, effects: int, out: Path, key: Path) -> None:
    """Write a sealed rig that starts from a scenario, and its key. Raises ConfigError."""
    if seed < 0 or not 0 <= effects <= 2:
        raise ConfigError(
            f"--seed {seed}, --effects {effects}: the seed must be 0 or more; allowed are 1 or 2 "
            "effects (0: either)"
        )
    content, _ = store.load("scenarios", scenario)
    if "sealed" in content:
        raise ConfigError(
            f"{scenario} is already sealed; give the scenario that the sealed rig shall start from"
        )
    hidden = draw(seed, effects)
    write(out, content, hidden)
    lines = "".join(f"- {words}\n" for words in hidden["words"])
    with writing(key):
        make_folder(key.parent)
        write_text(key, f"{out.name} hides:\n{lines}")


def write(out: Path, scenario: Mapping[str, Any], hidden: Mapping[str, Any]) -> None:
    """Write a sealed rig from a scenario as plain data and a hidden content. Raises ConfigError."""
    content = {
        **scenario,
        "title": "A rig that hides something",
        "sealed": seal.encode(dict(hidden)).replace("\n", ""),
    }
    head = (
        "# The effects that this rig hides are encoded below. Its key describes them.\n"
        f"# To find them from stops: rollerrig discover {shlex.quote(out.name)}\n"
    )
    with writing(out):
        make_folder(out.parent)
        write_text(out, head + tomli_w.dumps(content))


def causes(scenario: Path) -> set[str]:
    """Return the causes that a sealed rig hides. Raises ConfigError.

    This is for judging an answer, never for finding it.
    """
    content, path = store.load("scenarios", str(scenario))
    hidden = seal.decode(content.get("sealed", ""), f"{path}: sealed")
    return set(hidden["causes"])
