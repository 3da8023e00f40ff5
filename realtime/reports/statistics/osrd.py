"""The braking parameters of ETCS as OSRD reads them: `etcs_brake_params` of a rolling stock.

A curve has the values of intervals of speed, and the boundaries between them; it begins at 0 and
ends at the largest speed of the train. A campaign knows the emergency deceleration and its factors.
What it does not know comes from a file, and has no default.

Source: OSRD (OpenRailAssociation), editoast/schemas/src/rolling_stock/etcs_brake_params.rs, commit
67ad641e23cf. There the factors are `k_dry` and `k_wet`; other versions of OSRD have `k_dry_rst` and
`k_wet_rst`.
"""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rollerrig.configs import store, table
from rollerrig.configs.errors import ConfigError
from rollerrig.configs.output_files import make_folder, write_text, writing

KM_H = 3.6
FILE = "osrd.json"
# what a campaign does not know
ROWS = (
    table.number("gamma_service_m_s2", None, 0.01, 10.0, "deceleration of the full service brake"),
    table.number(
        "gamma_normal_service_m_s2", None, 0.01, 10.0, "deceleration of the guidance curve"
    ),
    table.number("k_n_pos_m_s2", None, 0.0, 10.0, "Kn+, correction on rising gradients"),
    table.number("k_n_neg_m_s2", None, 0.0, 10.0, "Kn-, correction on falling gradients"),
    table.number("t_traction_cut_off_s", None, 0.0, 60.0, "until the traction is off"),
    table.number("t_bs1_s", None, 0.0, 60.0, "build-up of the service brake, for SBI1"),
    table.number("t_bs2_s", None, 0.0, 60.0, "build-up of the service brake, for SBI2"),
    table.number("t_be_s", None, 0.0, 60.0, "safe build-up of the emergency brake"),
)
Factors = Mapping[str, Any]  # of `campaign.etcs.table`


def read(path: Path) -> dict[str, float]:
    """Return the values of a file that a campaign does not know. Raises ConfigError."""
    content = store.parse(path)
    missing = [row.name for row in ROWS if row.name not in content]
    if missing:
        raise ConfigError(
            f"{path}: {', '.join(missing)} is missing; OSRD needs it, and no campaign knows it"
        )
    return table.read(ROWS, content, str(path))


def parameters(factors: Factors, level: int, train: Mapping[str, float]) -> dict[str, Any]:
    """Return the object `etcs_brake_params` for a confidence level M_NVEBCL.

    `factors` has steps of speed, `train` the values of `read`. Raises ConfigError if a step has no
    bound at the level or no factor for wet rails.
    """
    steps = factors["steps"]
    dry = []
    wet = []
    for step in steps:
        at = f"{step['from_km_h']:g} to {step['to_km_h']:g} km/h"
        found = next(one for one in step["kdry_rst"] if one["m_nvebcl"] == level)
        if found["bound"] is None:
            raise ConfigError(
                f"--ebcl {level}: {at} has no bound of Kdry_rst at this level; give a lower --ebcl, or "
                "make more runs"
            )
        if step["kwet_rst"] is None or step["kwet_rst"]["estimate"] is None:
            raise ConfigError(
                f"{at} has no Kwet_rst, which OSRD needs; give a campaign on wet rails as WET"
            )
        dry.append(min(found["bound"], 1.0))
        wet.append(min(step["kwet_rst"]["estimate"], 1.0))
    boundaries_m_s = [step["from_km_h"] / KM_H for step in steps[1:]]
    return {
        "gamma_emergency": _curve(boundaries_m_s, [step["nominal_m_s2"] for step in steps]),
        "gamma_service": _curve((), (train["gamma_service_m_s2"],)),
        "gamma_normal_service": _curve((), (train["gamma_normal_service_m_s2"],)),
        "k_dry": _curve(boundaries_m_s, dry),
        "k_wet": _curve(boundaries_m_s, wet),
        "k_n_pos": _curve((), (train["k_n_pos_m_s2"],)),
        "k_n_neg": _curve((), (train["k_n_neg_m_s2"],)),
        "t_traction_cut_off": train["t_traction_cut_off_s"],
        "t_bs1": train["t_bs1_s"],
        "t_bs2": train["t_bs2_s"],
        "t_be": train["t_be_s"],
    }


def _curve(boundaries_m_s: Sequence[float], values: Sequence[float]) -> dict[str, list[float]]:
    return {"boundaries": list(boundaries_m_s), "values": list(values)}


def write(parameters_of_train: Mapping[str, Any], out: Path) -> Path:
    """Write the object to a file in a folder, and return its path. Raises ConfigError."""
    path = out / FILE
    with writing(out):
        make_folder(out)
        write_text(path, json.dumps(parameters_of_train, indent=1))
    return path
