"""Brake models of a train as one table, to be typed into a tool for ETCS brake curves.

A row is a combination of brakes and a step of speed. The names are those of the documentation of
the ETCS Brake Model Tool: AD is A_brake_emergency, Tbu is T_brake_build_up, KT_rst the factor of
the latter. The tool has ten levels EBCL; 0 is the nominal model, whose Kdry_rst is 1. Its file
format is not public, so this is a table for people.
"""

import csv
import io
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rollerrig.configs.output_files import make_folder, write_text, writing
from rollerrig.realtime.campaign.statistics import corrections

FILE = "brake_models.csv"
HEAD = (
    "combination",
    "v_from_km_h",
    "v_to_km_h",
    "ad_m_s2",
    *(f"kdry_rst_ebcl_{level}" for level in corrections.LEVELS),
    "kwet_rst",
    "tbu_s",
    *(f"kt_rst_ebcl_{level}" for level in corrections.LEVELS),
)
Table = Mapping[str, Any]  # of `campaign.etcs.table`


def rows(name: str, table: Table) -> list[list[Any]]:
    """Return the rows of a combination under HEAD; None where there is no value.

    Factors are lower bounds, rounded down; those of the build-up are bounds, rounded up.
    """
    build_up = table["build_up"]
    nominal_s = None
    of_time: list[float | None] = [None] * len(corrections.LEVELS)
    if build_up:
        nominal_s = round(build_up["nominal_s"], 3)
        of_time = [1.0]
        for level in build_up["levels"][1:]:
            bound_s = level["bound_s"]
            factor = None
            if bound_s is not None:
                factor = _rounded(bound_s / build_up["nominal_s"], math.ceil)
            of_time.append(factor)
    found = []
    for step in table["steps"]:
        bounds = [level["bound"] for level in step["kdry_rst"][1:]]
        dry = [None if bound is None else _rounded(bound, math.floor) for bound in bounds]
        wet = step["kwet_rst"]
        on_wet_rails = None
        if wet and wet["estimate"]:
            on_wet_rails = _rounded(wet["estimate"], math.floor)
        speeds_km_h = [step["from_km_h"], step["to_km_h"]]
        nominal_m_s2 = round(step["nominal_m_s2"], 4)
        # the nominal model is level 0
        found.append(
            [name, *speeds_km_h, nominal_m_s2, 1.0, *dry, on_wet_rails, nominal_s, *of_time]
        )
    return found


def write(tables: Mapping[str, Table], out: Path) -> Path:
    """Write the models of all combinations to a file in a folder; return its path.

    Raises ConfigError.
    """
    text = io.StringIO()
    first = next(iter(tables.values()))
    text.write(f"# {first['notice']}\n")
    for assumption in first["assumptions"]:
        text.write(f"# {assumption}\n")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(HEAD)
    for name, table in tables.items():
        for row in rows(name, table):
            writer.writerow("" if value is None else value for value in row)
    path = out / FILE
    with writing(out):
        make_folder(out)
        write_text(path, text.getvalue())
    return path


def _rounded(value: float, direction: Any) -> float:
    return float(direction(value * 1000.0) / 1000.0)
