"""Writes the table of docs/measured.md: what `explain` answers on public measured data.

    python tests/rig/identify/measured_page.py docs/measured.md

explains each set, holds the answer against what is known independently, and replaces the rows of
the table in the page. What is known is a count or a ratio that is computed here from the file
without any code under test, or it is in the source.
"""

import argparse
import contextlib
import io
import json
import re
import sys
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rollerrig.realtime import cli

MEASURED = Path(__file__).parents[2] / "data" / "measured"
PACKAGED = Path(__file__).parents[3] / "configs" / "datasets"
HEAD = "| set | known independently | what `explain` answers | judged |"

Result = dict[str, Any]


class Set(NamedTuple):
    """A measured set; `judge` returns "right", "partly: ..." or "wrong: ..." of a report.json."""

    folder: str
    known: Callable[[], str]
    judge: Callable[[Result], str]


# --- what is known, without code under test ---


def columns(folder: str, file: str = "a.csv") -> np.ndarray:
    """Return the columns of a file of a set."""
    place = MEASURED / folder
    if not place.is_dir():
        place = PACKAGED / folder
    lines = [line for line in (place / file).read_text().splitlines() if line[0] != "#"]
    return np.genfromtxt(io.StringIO("\n".join(lines)), delimiter=",", names=True)


def radius_percent(folder: str, speed: str, reference: str) -> float:
    """Return by how much a radius is larger than assumed, from distances above 3 m/s, in %."""
    data = columns(folder)
    fast = (data[reference] > 3.0) & np.isfinite(data[speed])
    return 100.0 * (data[reference][fast].sum() / data[speed][fast].sum() - 1.0)


def fall_of_locomotive() -> float:
    """Return the fall from the mean at 2 to 4 % creepage to the mean beyond 15 %."""
    data = columns("eurosprinter_127001", "curve.csv")
    top = data["adhesion"][(data["creepage"] > 0.02) & (data["creepage"] < 0.04)].mean()
    return 1.0 - data["adhesion"][data["creepage"] > 0.15].mean() / top


def slip_percent(folder: str, file: str) -> float:
    """Return the mean slip of wheel 1 against the camera in %, without the start."""
    data = columns(folder, file)
    steady = data[data.size // 4 :]
    return 100.0 * (1.0 - steady["camera_m_s"].sum() / steady["wheel_1_m_s"].sum())


# --- whether an answer is right ---


def causes(result: Result, name: str) -> list[Result]:
    """Return the causes with this name."""
    return [cause for cause in result["causes"] if cause["name"] == name]


def others(result: Result, *names: str) -> list[str]:
    """Return the names of the other findings, without repetition."""
    found = [*result["causes"], *result.get("episodes", [])]
    if isinstance(result.get("unknown"), list):
        found += result["unknown"]
    return sorted({cause["name"] for cause in found} - set(names))


def holds(cause: Result, parameter: str, true: float) -> bool:
    """Whether the interval of a parameter contains a value."""
    low, high = cause["parameters"][parameter]["ci95"]
    return low <= true <= high


def judge_locomotive(result: Result) -> str:
    found = causes(result, "falling_friction")
    if not found:
        return "wrong: the fall is not reported"
    if others(result, "falling_friction"):
        return f"partly: also {', '.join(others(result, 'falling_friction'))}"
    is_held = holds(found[0], "fall", fall_of_locomotive())
    return "right" if is_held else "partly: its size is outside of the interval"


def judge_sand(result: Result) -> str:
    if result["causes"]:
        return f"wrong: {', '.join(others(result))}"
    return "right" if result["law"]["fits"] is False else "partly: the law is reported to fit"


def rover_wheels_known(folder: str) -> str:
    data = columns(folder, "curve.csv")
    levels = []
    for number in np.unique(data["series"]):
        late = (data["series"] == number) & (data["creepage"] > 0.15)
        levels.append(f"{data['adhesion'][late].mean():.2f}")
    return (
        f"five wheels on sand, each a series: means beyond 15 % slip of {', '.join(levels)}, so they "
        "differ; loads differ with the wheels"
    )


def judge_rover_wheels(result: Result) -> str:
    wrong = others(result, "series_differ")
    if wrong:
        return f"wrong: {', '.join(wrong)}"
    if result["law"]["fits"] is not False:
        return "partly: the law is reported to fit"
    if not causes(result, "series_differ"):
        return "partly: whether the series differ is not judged, since 27 points are too few"
    return "right"


# % of the radius, by GNSS over the whole drive of the car
COMMA_DRIVE_RADII = (0.85, 0.80, 0.94, 0.99)

COMMA_WHEELS = ("wheel_fl_m_s", "wheel_fr_m_s", "wheel_rl_m_s", "wheel_rr_m_s")


def comma_radii() -> list[float]:
    return [radius_percent("comma_60s_mit", wheel, "gnss_speed_m_s") for wheel in COMMA_WHEELS]


def judge_comma(radii: Callable[[], Sequence[float]]) -> Callable[[Result], str]:
    def judge(result: Result) -> str:
        found = causes(result, "wheel_radius")
        by_axle = {cause["axles"][0]: cause for cause in found}
        wrong = [
            axle
            for axle, true in enumerate(radii(), start=1)
            if axle not in by_axle or not holds(by_axle[axle], "size", true)
        ]
        if others(result, "wheel_radius"):
            return f"partly: also {', '.join(others(result, 'wheel_radius'))}"
        if wrong:
            return f"partly: wheel {', '.join(map(str, wrong))} not, or outside of the interval"
        return "right"

    return judge


def judge_obd(folder: str, *allowed: str) -> Callable[[Result], str]:
    def judge(result: Result) -> str:
        if causes(result, "clock_step"):
            return "wrong: a gap is reported as a step of the clock"
        missing = [name for name in allowed if not causes(result, name)]
        if missing:
            return f"partly: {', '.join(missing)} is not reported"
        more = others(result, "wheel_radius", *allowed)
        if more:
            return f"partly: also {', '.join(more)}"
        true = radius_percent(folder, "obd", "reference_speed_m_s")
        found = causes(result, "wheel_radius")
        if not found:
            return "partly: no scale is reported"
        is_held = holds(found[0], "size", true)
        return "right" if is_held else "partly: the scale is outside of the interval"

    return judge


def judge_robot(result: Result) -> str:
    if result["verdict"] == "not_judged":
        return "right: refused with the reasons"
    if causes(result, "driving_slip"):
        return "right"
    return f"wrong: {result['verdict']}, {', '.join(others(result)) or 'nothing'}"


def judge_turning_robot(result: Result) -> str:
    """Judge the answer on a robot whose wheels differ because it turns."""
    found = others(result)
    if found:
        return f"wrong: {', '.join(found)}"
    if result["verdict"] == "not_judged":
        return "right: refused with the reasons"
    return "right: nothing is reported"


def judge_robot_creep(result: Result) -> str:
    if not causes(result, "series_differ"):
        return "wrong: the surfaces are not distinguished"
    if causes(result, "falling_friction"):
        return "wrong: a fall"
    load = causes(result, "load_dependent_friction")
    if not load or load[0]["parameters"]["change"]["value"] > 0.0:
        return "wrong: adhesion is not reported to fall with load"
    if causes(result, "speed_dependent_friction"):
        return (
            "partly: the surfaces differ; but the speed falls with sliding, and a dependence of "
            "friction on it is reported"
        )
    return "right"


def _obd_known(folder: str, more: str = "") -> Callable[[], str]:
    def known() -> str:
        share = radius_percent(folder, "obd", "reference_speed_m_s")
        return f"distance by OBD {share:.2f} % less than by INS (radius {share:+.2f} %){more}"

    return known


def _sand_known(folder: str) -> str:
    data = columns(folder, "curve.csv")
    slips = np.round(data["creepage"], 1)
    means = [data["adhesion"][slips == slip].mean() for slip in np.unique(slips)]
    texts = [f"{mean:.2f}" for mean in means]
    return (
        f"on sand; means at slips of {', '.join(f'{slip:g}' for slip in np.unique(slips))}: "
        f"{', '.join(texts)}, each larger than the one before"
    )


def _surfaces_known(folder: str) -> str:
    data = columns(folder, "curve.csv")
    is_light = data["wheel_load_N"] < data["wheel_load_N"].mean()
    light = []
    falls = []
    for surface in np.unique(data["series"]):
        here = data["series"] == surface
        light.append(float(data["adhesion"][here & is_light].mean()))
        heavy = float(data["adhesion"][here & ~is_light].mean())
        falls.append(100.0 * (1.0 - heavy / light[-1]))
    means = ", ".join(f"{mean:.2f}" for mean in light)
    return (
        f"four surfaces, each a series: mean adhesion of {means} at 30 N, and at 50 N "
        f"{', '.join(f'{fall:.0f}' for fall in falls)} % less, since the force is from motor "
        "current with the gear's friction; the rims turn at nearly one speed"
    )


# m, between the wheels of the Kobuki robot, by its manufacturer
_KOBUKI_TRACK_M = 0.23


def _turning_known(folder: str) -> Callable[[], str]:
    def known() -> str:
        data = columns(folder)
        turning_rad_s = (data["right_m_s"] - data["left_m_s"]) / _KOBUKI_TRACK_M
        agreement = np.corrcoef(turning_rad_s, data["yaw_rad_s"])[0, 1]
        faster = np.maximum(data["left_m_s"], data["right_m_s"])
        moves = faster > 0.3
        slower = np.minimum(data["left_m_s"], data["right_m_s"])
        share = 100.0 * np.median(1.0 - slower[moves] / faster[moves])
        return (
            f"the wheels differ by {share:.0f} % (median), as the gyro turns (correlation "
            f"{agreement:.2f}): the robot drives curves"
        )

    return known


def _robot_known(folder: str, files: tuple[str, ...]) -> Callable[[], str]:
    def known() -> str:
        slips = " and ".join(f"{slip_percent(folder, file):.0f} %" for file in files)
        return f"drives at up to 0.2 m/s with a mean slip of {slips} against the camera"

    return known


SETS = (
    Set(
        "eurosprinter_127001",
        lambda: (
            f"mean adhesion falls by {100.0 * fall_of_locomotive():.0f} % from 2 to 4 % creepage "
            "to beyond 15 %; wet track"
        ),
        judge_locomotive,
    ),
    Set(
        "terramech_smooth_mit",
        lambda: _sand_known("terramech_smooth_mit"),
        judge_sand,
    ),
    Set(
        "terramech_grouser_mit",
        lambda: _sand_known("terramech_grouser_mit"),
        judge_sand,
    ),
    Set("sand_rover_mit", lambda: rover_wheels_known("sand_rover_mit"), judge_rover_wheels),
    Set(
        "comma_60s_mit",
        lambda: (
            "distances by GNSS and wheels: radii "
            f"{', '.join(f'{share:+.2f}' for share in comma_radii())} %; nothing else is known"
        ),
        judge_comma(comma_radii),
    ),
    Set(
        "comma_50hz_mit",
        lambda: (
            "the same car; distances of the whole drive by GNSS: radii "
            f"{', '.join(f'{share:+.2f}' for share in COMMA_DRIVE_RADII)} %; the receiver has a new "
            "value every fifth row; the car turns at low speed"
        ),
        judge_comma(lambda: COMMA_DRIVE_RADII),
    ),
    Set(
        "obd_gap_mit",
        _obd_known("obd_gap_mit", "; no samples for 622 s, cut out"),
        judge_obd("obd_gap_mit", "sensor_dropout"),
    ),
    Set("kingston_obd_mit", _obd_known("kingston_obd_mit"), judge_obd("kingston_obd_mit")),
    Set("toronto_obd_mit", _obd_known("toronto_obd_mit"), judge_obd("toronto_obd_mit")),
    Set("kingston_end_mit", _obd_known("kingston_end_mit"), judge_obd("kingston_end_mit")),
    Set("toronto_end_mit", _obd_known("toronto_end_mit"), judge_obd("toronto_end_mit")),
    Set("kobuki_turns_apache", _turning_known("kobuki_turns_apache"), judge_turning_robot),
    Set("kobuki_yaw_apache", _turning_known("kobuki_yaw_apache"), judge_turning_robot),
    Set("robot_table_apache", _robot_known("robot_table_apache", ("1.csv",)), judge_robot),
    Set("robot_green_apache", _robot_known("robot_green_apache", ("1.csv", "2.csv")), judge_robot),
    Set(
        "robot_slip_apache",
        lambda: _surfaces_known("robot_slip_apache"),
        judge_robot_creep,
    ),
)


# --- the page ---


def explain(folder: str, out: Path) -> Result:
    """Return report.json of a set, explained as a user does."""
    place = MEASURED / folder
    name = str(place) if place.is_dir() else folder
    with contextlib.redirect_stdout(io.StringIO()):
        status = cli.main(["explain", name, "--out", str(out)])
    assert status == 0, f"{folder}: explain exits with {status}"
    return json.loads((out / "report.json").read_text())


def answer(result: Result) -> str:
    """Return the answer of a report in a few words."""
    words = []
    for cause in result["causes"]:
        parameters = cause["parameters"]
        size = next(iter(parameters.values()))
        scale = 1.0
        unit = size.get("unit", "")
        if unit in ("of the maximum", "of adhesion"):
            scale = 100.0
            unit = f"% {unit}"
        low, high = size["ci95"]
        place = ", ".join(cause.get("channels", []))
        words.append(
            f"`{cause['name']}` {place} {scale * size['value']:.3g} "
            f"({scale * low:.3g} to {scale * high:.3g}) {unit}".replace("  ", " ")
        )
    if result.get("episodes"):
        words.append(f"{len(result['episodes'])} slides")
    if isinstance(result.get("unknown"), list):
        words += [f"unknown: {finding['text']}" for finding in result["unknown"][:2]]
    law = result.get("law")
    if law:
        fit = "fits" if law["fits"] else "does not fit"
        scatter = result["misfit"]["noise_floor"]
        words.append(f"Polach's law {fit}: rms {law['rms']:.3g}, scatter {scatter:.2g}")
    not_judged = sum(not check["judged"] for check in result.get("checks", []))
    checks = len(result.get("checks", []))
    if checks:
        words.append(f"{checks - not_judged} of {checks} checks judged")
    return f"**{result['verdict'].replace('_', ' ')}**: {'; '.join(words)}"


def rows() -> list[str]:
    """Return the rows of the table."""
    lines = []
    for one in SETS:
        with tempfile.TemporaryDirectory() as out:
            result = explain(one.folder, Path(out))
        cells = (f"`{one.folder}`", one.known(), answer(result), one.judge(result))
        lines.append(f"| {' | '.join(cells)} |")
    return lines


def with_rows(text: str, lines: list[str]) -> str:
    """Return the text of the page with these rows."""
    table = "\n".join(["|---|---|---|---|", *lines]) + "\n"
    behind_head = re.compile(rf"(?<=^{re.escape(HEAD)}\n)(?:\|.*\n)+", re.MULTILINE)
    assert behind_head.search(text), "the page has no table"
    return behind_head.sub(lambda _: table, text)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("page", type=Path)
    given = parser.parse_args()
    text = given.page.read_text(encoding="utf-8")
    given.page.write_text(with_rows(text, rows()), encoding="utf-8")


if __name__ == "__main__":
    sys.exit(main())
