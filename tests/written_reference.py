"""Pages of reference that are written from tables of the code: `make docs` writes them.

Each page is a function that returns its Markdown. `PAGES` has them by file name.
"""

import argparse
import math
import re

from paper import large_sliding

from rollerrig.configs import store
from rollerrig.configs.number_text import rounded
from rollerrig.configs.vehicle import COACH, EQUIPMENT_KEYS, MOST_CARS
from rollerrig.firmware_sim.faults import catalogue
from rollerrig.firmware_sim.wsp import logic
from rollerrig.realtime import cli
from rollerrig.realtime.bench import scenario
from rollerrig.realtime.campaign import campaign, combined, design, speed_steps
from rollerrig.realtime.campaign.components import failures, train
from rollerrig.realtime.campaign.statistics import laws
from rollerrig.realtime.record import run_folder
from rollerrig.realtime.reports.statistics import osrd
from rollerrig.realtime.train import plan as train_plan
from rollerrig.rig import brake_calculation
from rollerrig.rig.mechanisms import table as mechanisms
from rollerrig.rig.train import coupler
from rollerrig.wsp_interface import harness_client, signals
from rollerrig.wsp_interface.sequences import conditions, measures, sequence, verdict

# where each packaged set of adhesion may be used
USES = {
    "dry": "dry and clean rail, and the clean limit of the others. It is the recovered curve of the "
    "paper's Table 4, a contact that is cleaner than rails in service: at 120 km/h it has twice what "
    "Curtius and Kniffler measured (0.21). No packaged brake reaches either, so stops do not differ",
    "low": "tests of WSP on low adhesion (0.05 to 0.08)",
    "soap": "the paper's stops: soap and water, first wheel of a train",
    "very_low": "tests of WSP on very low adhesion; crushed leaves, paper tape",
    "wet_clean": "rain on a clean rail; a WSP hardly acts",
    "wet_design": "wet rail at the design adhesion (0.12 to 0.15), on which a WSP acts",
    "wet_leaves": "wet leaves; earlier name `leaf_film`. A full-scale rig found such adhesion on leaf "
    "layers (Lewis and others, Tribology International 185, 2023, abstract read)",
}
SLIPS = (0.02, 0.10, 0.20, 1.0)
SPEEDS_KM_H = (40, 80, 160)

WRITTEN = "`make docs` writes this page from the code."
# units at the ends of names of keys and signals
UNITS = {
    "Hz": "Hz",
    "hz": "Hz",
    "J": "J",
    "J_K": "J/K",
    "J_m": "J/m",
    "K": "K",
    "L": "L",
    "MJ": "MJ",
    "N": "N",
    "NL": "NL",
    "N_Pa": "N/Pa",
    "N_s": "N/s",
    "1_s": "1/s",
    "NL_s_bar": "NL/(s bar)",
    "N_m": "N/m",
    "N_s2_m2": "N s²/m²",
    "N_s_m": "N s/m",
    "Nm": "N m",
    "Nm_rad": "N m/rad",
    "Pa": "Pa",
    "W": "W",
    "bar": "bar",
    "kg": "kg",
    "kg_m": "kg/m",
    "kg_s": "kg/s",
    "kgm2": "kg m²",
    "km_h": "km/h",
    "m": "m",
    "m2": "m²",
    "m_J": "m/J",
    "m_s": "m/s",
    "m_s2": "m/s²",
    "mm3_J": "mm³/J",
    "rad": "rad",
    "rad_s": "rad/s",
    "rad_s_m": "rad/(s m)",
    "s": "s",
    "s2_m": "s²/m",
    "s_m": "s/m",
    "us": "µs",
}
SECTIONS = {
    "contact": "the contact of wheel and rail or roller",
    "adhesion": "the law of adhesion",
    "vehicle": "the vehicle in the plane",
    "brake": "cylinders, levers and discs",
    "dynamic_brake": "[motors that brake and drive](dynamic_brake.md), and blending",
    "magnetic_track_brake": "[magnets on the rail](vehicles.md#magnetic-track-brake)",
    "pads": "friction of the pads",
    "valve": "dump valves",
    "air": "the supply of air",
    "sanders": "sanders",
    "drive": "rollers and their motors",
    "sensor": "speed sensors",
    "flats": "flats on wheels",
    "roller_film": "contaminant on the rollers",
    "dry_roller": "the dry rollers of a virtual track",
    "mechanisms": "effects beyond the base model; with 0 there is none",
    "rig": "the rig, and how it runs",
    "multibody": "the coach in 3D",
    "loop": "the real-time loop",
    "bus": "the bus",
    "modbus": "the supervisory PLC",
}
FILES = {
    run_folder.SCENARIO: "the scenario with every default; `rollerrig run` repeats the run from it. "
    "Of a sequence or another test: what the bench began with; play the test again to repeat the run",
    run_folder.CHANNELS: "all [signals](signals.md), in SI units, at `loop.record_hz`",
    run_folder.TAIL: "samples of a run that was killed, which the file above does not hold yet",
    run_folder.EVENTS: "one [event](events.md) a line, as JSON",
    run_folder.SUMMARY: "what was played, the figures of the stop, the loop and the bus, and whether it is valid",
    run_folder.CAN_LOG: "every frame, in the format of `candump -l`: `canplayer -I can.log` replays it, "
    "python-can's `LogReader` reads it, and `python -m can.logconvert can.log can.blf` "
    "converts it (`.asc` also)",
    run_folder.RRD: "the recording for the viewer Rerun",
    run_folder.UNIT_LOG: "what the unit printed, where the bench started it",
    run_folder.UNIT_CAN_LOG: "the frames on a bus of the unit's own, as `candump -l` writes them",
    run_folder.TRACE: "what a harness read, one line a bus cycle, where a sequence was played",
}
# environment variables that the product reads or sets
ENVIRONMENT = {
    "DISPLAY": "one of these two set: there is a screen for the window of the viewer",
    "WAYLAND_DISPLAY": "as `DISPLAY`",
    "NUMBA_CACHE_DIR": "folder of compiled kernels, instead of the one in the cache",
    "PYTHONSAFEPATH": "set for child processes, which then import nothing from the working folder",
    "ROLLERRIG_AXLES": "no longer read, because the vehicle has its number of axles; a start with it "
    "set says so",
    "ROLLERRIG_EQUIPMENT": "no longer read, because the vehicle has its equipment; a start with it set "
    "says so",
    "ROLLERRIG_PYTHON": "Python that the rig as an FMU starts; it must have rollerrig installed "
    "([which one else](units.md#the-rig-as-an-fmu))",
    "RUST_LOG": "messages of Rerun; by default errors only",
    "TMPDIR": "folder of temporary files",
    "USER": "the user whom `rollerrig check` names in its advice",
    "VK_DRIVER_FILES": "descriptions of Vulkan drivers, which `rollerrig check` looks for",
    "VK_ICD_FILENAMES": "as `VK_DRIVER_FILES`, its older name",
    "XDG_CACHE_HOME": "folder in which compiled kernels are kept; by default `~/.cache`",
    "XDG_CONFIG_HOME": "set for the viewer, so that it sends no report of use",
    "_ARGCOMPLETE": "set by a shell that completes a command line",
}


def unit(name):
    """Return the unit of a key from the end of its name; "" for a pure number or a text."""
    words = name.split("_")
    # the longest end first; a name is never a unit only
    for first in range(1, len(words)):
        end = "_".join(words[first:])
        if end in UNITS:
            return UNITS[end]
    return ""


def value(content):
    """Return a value of TOML as a page shows it."""
    if isinstance(content, bool):
        return f"`{str(content).lower()}`"
    if isinstance(content, str):
        return f'`"{content}"`' if content else ""
    if isinstance(content, tuple):
        return ", ".join(f"{one:g}" for one in content)
    return "" if content is None else f"{content:g}"


def allowed(row):
    """Return the allowed values of a row."""
    if isinstance(row.default, bool):
        return "`true`, `false`"
    if isinstance(row.default, str):
        return ", ".join(f"`{choice}`" for choice in row.choices) or "text"
    if row.low <= -1e300 and row.high >= 1e300:
        return "any number"
    if math.isinf(row.high):
        return f"from {row.low:g}"
    return f"{row.low:g} to {row.high:g}"


def default(row):
    """Return the default of a row; one outside the bounds means that it is not given."""
    is_number = isinstance(row.default, int | float) and not isinstance(row.default, bool)
    if is_number and not row.low <= row.default <= row.high:
        return ""
    return value(row.default)


def key_table(rows):
    """Return the lines of a table of keys."""
    lines = ["| key | unit | default | allowed | meaning and source |", "|---|---|---|---|---|"]
    for row in rows:
        of_row = unit(row.name)
        source = "" if row.source in ("-", of_row) else row.source
        cells = (f"`{row.name}`", of_row, default(row), allowed(row), source)
        lines.append(f"| {' | '.join(cells)} |")
    return lines


def scenario_keys():
    """Return the page of all keys of a scenario."""
    lines = [
        "# Keys of a scenario",
        "",
        "This page is for everybody who writes a scenario, a vehicle, a rig or another set. After reading "
        f"it you know every key with its unit, default and allowed values. {WRITTEN}",
        "",
        "A scenario is a TOML file. Its sets (`vehicle`, `rig`, `adhesion`, `bus`, `pads`) are names of "
        "files in `configs/`, or paths. A set may contain every table of this page. A later layer wins: "
        "defaults, vehicle, rig, adhesion, bus, pads, the tables of the scenario, an extended model "
        "(`--model`), `--set table.key=value`. `rollerrig list scenarios` prints the names.",
        "",
        "## At the top of the file",
        "",
    ]
    heads = [row._replace(name=row.name.removesuffix("_set")) for row in scenario.HEAD]
    lines += key_table(heads)
    for section, rows in scenario.SECTIONS.items():
        lines += ["", f"## [{section}]", "", f"{SECTIONS[section].capitalize()}.", ""]
        if section == "mechanisms":
            lines += mechanism_table()
        else:
            lines += key_table(rows)
        if section == "adhesion":
            lines += ["", *adhesion_sets()]
    lines += [
        "",
        "## [[demand]]",
        "",
        "Steps of the brake demand, rising in time.",
        "",
        *key_table(scenario.DEMAND),
        "",
        "## [[traction]]",
        "",
        "Steps of the demand of traction, rising in time, for a vehicle with motors "
        "(`[dynamic_brake] traction_force_N`). It acts while no brake is demanded.",
        "",
        *key_table(scenario.TRACTION),
        "",
        "## [[friction]]",
        "",
        "Steps of friction, each from a time (`from_s`) or a place (`from_m`). `axles` is a list of axles, by "
        "default all; a value that is not given is that of `[adhesion]`.",
        "",
        *key_table(scenario.FRICTION),
        "",
        "Instead of `mu_cd` a step can have `profile`, the path of a CSV file with the columns "
        "`position_m, adhesion`: the initial adhesion of a line by place, with its position 0 at "
        "`from_m` (default 0) ([how](howto_run.md#play-the-adhesion-of-a-line)).",
        "",
        "## [train]",
        "",
        "A scenario with this table is a train ([how](howto_train.md)). All tables above hold for all its "
        "cars; a car may replace them for itself.",
        "",
        *key_table(train_plan.HEAD),
        "",
        "## [[train.car]]",
        "",
        "A car of the train, from the front to the rear; 1 to "
        f"{MOST_CARS} in all. Behind it can be tables for this car alone, such as "
        "`[train.car.brake]`.",
        "",
        *key_table([row._replace(name=row.name.removesuffix("_set")) for row in train_plan.CAR]),
        "",
        "## [[train.emergency]]",
        "",
        "Emergency valves on the brake pipe.",
        "",
        *key_table(train_plan.EMERGENCY),
        "",
        "## [coupler]",
        "",
        "In a file of its own, in `configs/couplers` or by its path. A curve goes on behind its last point.",
        "",
        *key_table(coupler.ROWS),
        "",
        "## [[fault]]",
        "",
        "`kind` is a [fault](faults.md), whose parameters are further keys.",
        "",
        *key_table(catalogue.WHEN),
    ]
    return "\n".join(lines) + "\n"


def adhesion_sets():
    """Return the lines on the packaged sets of adhesion: a table of their values, and its use."""
    sets = {name: store.load("adhesion", name)[0] for name in store.names("adhesion")}
    lines = [
        "**Which value wins.** `initial_adhesion` and `mu_cd` exclude each other, because `mu_cd` follows "
        "from `initial_adhesion`. Of two layers the later one wins: a `mu_cd` in the scenario or with "
        "`--set` replaces the initial adhesion of a set such as `low` (the run prints it, event "
        "`scenario.adhesion_replaced`), and a later `initial_adhesion` replaces a `mu_cd`. One layer that "
        "has both is refused, unless the two agree within 1 %; all `--set` options together are one "
        "layer. `scenario.toml` in the folder of the run has the values that were used.",
        "",
        "**The packaged sets** (`configs/adhesion`, with the sources and assumptions). An empty cell is "
        "the default of the table above; of `[mechanisms]` it is 0, no effect. In `low` and `very_low` "
        "`mu_cd` follows from `initial_adhesion`. The defaults are the paper's law at every sliding, and "
        "a dataset without `[adhesion]` has them. With the sets cleaning fades at large sliding "
        "([why](paper.md#adhesion-at-large-sliding)).",
        "",
        *adhesion_of_wheels(sets),
        "",
        f"| key | {' | '.join(f'`{name}`' for name in sets)} |",
        "|---" * (len(sets) + 1) + "|",
    ]
    for section in ("adhesion", "mechanisms"):
        keys = dict.fromkeys(key for content in sets.values() for key in content.get(section, {}))
        for key in keys:
            values = [value(content.get(section, {}).get(key)) for content in sets.values()]
            shown = f"`{key}`" if section == "adhesion" else f"`[{section}] {key}`"
            lines.append(f"| {shown} | {' | '.join(values)} |")
    lines += [
        "",
        "The initial adhesion of `low` is the middle of 0.05 to 0.08, the range of tests of WSP "
        "(recollection, to be checked against EN 15595 and UIC 541-05). That of `very_low` is as of "
        "crushed leaves or of the paper tape of UIC 541-05 (recollection).",
    ]
    return lines


def adhesion_of_wheels(sets):
    """Return the lines of the table of what one wheel gets on each set."""
    lines = [
        "What one wheel of the coach gets at a slip of 2, 10, 20 % and locked, each at 40 / 80 / 160 "
        "km/h, on a rail that no wheel ahead has cleaned. `leaf_film` and `wet` are earlier names of "
        "`wet_leaves` and `wet_clean` and still work.",
        "",
        "| set | 2 % | 10 % | 20 % | locked | use for |",
        "|---|---|---|---|---|---|",
    ]
    for name in sets:
        params = large_sliding.params_of(name)
        cells = []
        for slip in SLIPS:
            at = (large_sliding.wheel(params, slip, v / 3.6)[0] for v in SPEEDS_KM_H)
            cells.append(" / ".join(f"{f:.3f}" for f in at))
        lines.append(f"| `{name}` | {' | '.join(cells)} | {USES[name]} |")
    return lines


def mechanism_table():
    """Return the lines of the table of mechanisms, whose rows have their units as texts."""
    lines = [
        "| key | unit | default | allowed | what happens and source |",
        "|---|---|---|---|---|",
    ]
    bounds = {row.name: row for row in mechanisms.rows()}
    for mechanism in mechanisms.IN_PLANT:
        meaning = f"{mechanism.text} ({mechanism.source})"
        for parameter in mechanism.parameters:
            row = bounds[f"{mechanism.name}_{parameter.name}"]
            unit_text = "" if row.source == "-" else row.source
            cells = (f"`{row.name}`", unit_text, default(row), allowed(row), meaning)
            lines.append(f"| {' | '.join(cells)} |")
            meaning = ""
    return lines


def _general(measure):
    """Return the meaning of a measure, with the keys whose values a report has."""
    return re.sub(r"\{(\w+)\[(\w+)\]:g\}", r"`\1.\2`", measure.text)


def _signals_of_conditions():
    """Return the rows of the signals that the conditions of a sequence may use."""
    table = signals.table(COACH)
    rows = []
    for name in harness_client.reception(table).received:
        signal = table.by_name[name]
        low, high = conditions.RANGES[name]
        axles = "yes" if len(signals.columns(signal)) > 1 else ""
        rows.append(
            f"| `{name}` | {axles} | {UNITS.get(signal.unit, signal.unit)} | {rounded(low, 6)} to {rounded(high, 6)} |"
        )
    return rows


def other_keys():
    """Return the page of the keys of other files than scenarios."""
    lines = [
        "# Keys of other files",
        "",
        "This page is for everybody who writes a campaign, a sequence or settings of the reference unit. "
        "After reading it you know the keys of "
        f"these files. {WRITTEN} Elsewhere: [datasets](datasets.md), [recorders](recorders.md), and the "
        "maps of [units](units.md).",
        "",
        "## Campaign",
        "",
        "At the top of a plan (`configs/campaigns`). [How to write one](howto_campaign.md).",
        "",
        *key_table(campaign.ROWS),
        "",
        "A range in `[vary]`, for a random design:",
        "",
        *key_table(design.RANGE),
        "",
        "An input in `[inputs]`, next to `distribution`, its parameters, `low`, `high` and `source`. `per` is "
        f"{', '.join(f'`{unit}`' for unit in train.UNITS[:-1])}: each of these units has its own value.",
        "",
        *key_table((laws.ELASTICITY, laws.IN_CAR, laws.BETWEEN_CARS)),
        "",
        "A component `[failures.NAME]`. Further keys are `places` (a list of numbers of units), `set` (values of "
        "the scenario) and the parameters of its fault. [How to write them](howto_kdry.md).",
        "",
        *key_table(failures.ROWS),
        "",
        "`[failures]` itself:",
        "",
        *key_table((failures.RAREST,)),
        "",
        "`[etcs]`, for the deceleration by steps of speed:",
        "",
        *key_table(speed_steps.ROWS),
        "",
        f"`[{combined.TABLE}.NAME]` has one key, `{combined.ISOLATES}`: a list of "
        f"{' and '.join(f'`{name}`' for name in EQUIPMENT_KEYS)}. "
        "[What it is for](campaigns.md#combinations-of-brakes).",
        "",
        "## Train for OSRD",
        "",
        "The file that the option `--train` of `rollerrig etcs` names. [What it is for](campaigns.md#for-osrd).",
        "",
        *key_table(osrd.ROWS),
        "",
        "## Brake units",
        "",
        "At the top of a file of brake units. [What it is for](howto_brake_calculation.md).",
        "",
        *key_table(brake_calculation.TRAIN_ROWS),
        "",
        "`[[brake_unit]]`; the symbols are those of `rig/brake_calculation.py`:",
        "",
        *key_table(brake_calculation.UNIT_ROWS),
        "",
        "## Reference unit",
        "",
        "`[wsp]` of a file in `configs/wsp`, which `wsp_config` of a scenario names.",
        "",
        *key_table(logic.ROWS),
        "",
        "## Sequence",
        "",
        "An example is on the page [Test sequences](sequences.md#a-sequence). A quantity is a text with its unit, as "
        '`"36 km/h"`.',
    ]
    places = {
        "At the top": sequence.HEAD,
        "`[start]`": sequence.START,
        "`[[step]]`": sequence.STEP,
        "`[[measure]]`": verdict.LIMIT,
    }
    for place, keys in places.items():
        lines += ["", f"{place}:", "", "| key | value |", "|---|---|"]
        lines += [f"| `{key}` | {value} |" for key, value in keys.items()]
    units = ", ".join(f"`{unit}`" for unit in conditions.UNITS if unit)
    lines += [
        "",
        f"Units: {units}.",
        "",
        "## Signals of a condition",
        "",
        "[Conditions](sequences.md#conditions) may use these signals and no others, here of the coach. A signal of "
        "the axles takes the number of an axle (`sliding_2`), or means all axles. A bound outside the range is "
        "refused, because no run can meet it.",
        "",
        "| signal | of each axle | SI unit | range in SI |",
        "|---|---|---|---|",
        *_signals_of_conditions(),
        "",
        "## Measures of a sequence",
        "",
        "A measure without a unit is a ratio, a number or an index.",
        "",
        "| measure | unit | meaning | not applicable |",
        "|---|---|---|---|",
    ]
    lines += [
        f"| `{measure.name}` | {measure.unit} | {_general(measure)} | {measure.absent} |"
        for measure in measures.MEASURES
    ]
    return "\n".join(lines) + "\n"


def command_line():
    """Return the page of all commands with their arguments."""
    lines = [
        "# Command line",
        "",
        "This page is for everybody who runs `rollerrig`. After reading it you know every command with "
        "its arguments and options. "
        f"{WRITTEN} `rollerrig COMMAND --help` prints the same.",
        "",
        "Every command also has `--json` (print one JSON object, and nothing else, on standard output). "
        "What a command returns: [exit status](exit_status.md).",
    ]
    for name, parser in _commands().items():
        verb = next(verb for verb in cli.VERBS if verb.name == name)
        lines += ["", f"## {name}", "", str(parser.description), "", f"    {verb.example}", ""]
        if verb.session:
            lines += ["A whole session:", "", *(f"    {line}" for line in verb.session), ""]
        rows = [row for action in parser._actions if (row := _argument(parser, action))]
        if rows:
            lines += ["| argument | meaning |", "|---|---|", *rows]
    return "\n".join(lines) + "\n"


def _commands():
    """Return the parser of each command, by name."""
    for action in cli.parser()._actions:
        if isinstance(action, argparse._SubParsersAction):
            return dict(action.choices)
    raise LookupError("the command line has no commands")


def _argument(parser, action):
    """Return the row of an argument; "" for a hidden one, and for those that all commands have."""
    if action.help == argparse.SUPPRESS or {"--help", "--json"} & set(action.option_strings):
        return ""
    formatter = parser._get_formatter()
    metavar = _metavar(action)
    names = [f"`{option} {metavar}`".replace(" `", "`") for option in action.option_strings]
    shown = ", ".join(names) or f"`{metavar}`"
    text = _in_cell(formatter._expand_help(action)) if action.help else ""
    of_action = action.default
    has_default = isinstance(of_action, str | int | float) and not isinstance(of_action, bool)
    if has_default and of_action != "" and "default" not in text:
        text += f" (default: {of_action})"
    return f"| {shown} | {text} |"


def _metavar(action):
    """Return the placeholder of a value; "" for a switch."""
    if action.nargs == 0:
        return ""
    if isinstance(action.metavar, tuple):
        return " ".join(action.metavar)
    if action.metavar:
        name = action.metavar
    elif action.choices:
        name = "{" + ",".join(map(str, action.choices)) + "}"
    else:
        name = action.dest.upper()
    return f"{name} ..." if action.nargs in ("+", "*") else name


def _in_cell(text):
    """Return a text for a cell of a table."""
    return re.sub(r"\s+", " ", text).replace("|", "\\|").replace("<", "&lt;")


def signal_table():
    """Return the page of all signals, with the columns of a record and the places on the bus."""
    lines = [
        "# Signals",
        "",
        "This page is for everybody who reads a record or the bus. After reading it you know every "
        "quantity of the rig: its unit, its columns in `channels.parquet`, and its places on the bus. "
        f"{WRITTEN}",
        "",
        "`1..4` stands for the axles of the default vehicle, counted from the leading end. A place is "
        "node, index and sub-index (of axle 1), the type, and the value of one count. `drive` is the node "
        "of the drive under the axle (1 to 4). [Which frames carry them](units.md); `rollerrig devices` "
        "writes EDS, DBC and a table of these objects. Direction: as seen from the rig.",
        "",
        "| columns | unit | meaning | direction | places on the bus |",
        "|---|---|---|---|---|",
    ]
    for signal in signals.table(COACH).signals:
        columns = signals.columns(signal)
        name = columns[0] if signal.axles == 1 else columns[0].replace("_1", "_1..4", 1)
        unit_text = UNITS.get(signal.unit, signal.unit)
        places = "; ".join(map(_place, signal.places))
        cells = (f"`{name}`", unit_text, signal.text, signal.direction, places)
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def _place(place):
    """Return a place of a signal on the bus, as text."""
    node = "drive" if place.node == signals.DRIVE_UNDER_AXLE else f"node {place.node}"
    scale = f"{place.scale:g}" + (f" x `{place.of}`" if place.of else "")
    wraps = ", wraps" if place.wraps else ""
    return f"{node} {place.index:04X}h:{place.sub} {place.kind} {scale}{wraps}"


def run_files():
    """Return the page of the files of a run."""
    lines = [
        "# Files of a run",
        "",
        "This page is for everybody who reads the folder of a run (`--out`) with other programs. After "
        "reading it you know its files. "
        f"{WRITTEN} The columns of `channels.parquet` are the [signals](signals.md). "
        "[More about runs](runs.md).",
        "",
        "| file | content |",
        "|---|---|",
        *(f"| `{name}` | {FILES[name]} |" for name in run_folder.FILES),
        f"| `{run_folder.MARK}` | marks a folder in which the next run may replace these files |",
    ]
    return "\n".join(lines) + "\n"


def exit_status():
    """Return the page of exit statuses and environment variables."""
    lines = [
        "# Exit status and environment",
        "",
        "This page is for everybody who calls `rollerrig` from a script or from CI. After reading it you "
        "know what each exit status means, and which variables of the environment act on a command. "
        f"{WRITTEN}",
        "",
        "## Exit status",
        "",
        "| status | meaning |",
        "|---|---|",
        *(f"| {status} | {text} |" for status, text in cli.EXIT_STATUSES.items()),
        "",
        "## Environment variables",
        "",
        "| variable | meaning |",
        "|---|---|",
        *(f"| `{name}` | {text} |" for name, text in ENVIRONMENT.items()),
    ]
    return "\n".join(lines) + "\n"


PAGES = {
    "scenario_keys.md": scenario_keys,
    "other_keys.md": other_keys,
    "command_line.md": command_line,
    "signals.md": signal_table,
    "run_files.md": run_files,
    "exit_status.md": exit_status,
}
