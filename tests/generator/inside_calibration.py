"""Prints which hidden forces became notes, because brakes inside their calibration explain them.

    cd tests; python -m generator.inside_calibration

The rule is that of `decision.py`: a cause that acts on the brake or on the vehicle is a note if
brakes that all vary in the same way, inside their calibration, are at least as likely. The table
is made from the kept answers. It has the sets with one hidden force. It counts those whose answer
has another verdict than `consistent`, those that are `consistent` with a note on a force inside the
calibration, and the others, which are not seen. Kept answers of an `explain` without this rule are
left out.
"""

from collections import defaultdict
from typing import Any, NamedTuple

from generator import thresholds

from rollerrig.rig.identify.causes import table
from rollerrig.rig.mechanisms.mechanism import TORQUE, VEHICLE

HEAD = "| hidden | generator | detected | a note | not seen | largest share of a note |"


class Row(NamedTuple):
    """One hidden force of one size, with the answers of one generator to it."""

    hidden: str
    size: float
    generator: str


def is_force(name: str) -> bool:
    """Return whether an effect is a cause that acts on the brake or on the vehicle."""
    if name not in table.BY_NAME:
        return False
    return table.BY_NAME[name].mechanism.acts_on in (TORQUE, VEHICLE)


def answers_by_row() -> dict[Row, list[dict[str, Any]]]:
    """Return the kept answers to one hidden force."""
    found = defaultdict(list)
    for folder in thresholds.folders():
        generator, key, answers = thresholds.read(folder)
        for name, answer in answers.items():
            effects = key[name]["effects"]
            if "immaterial" not in answer:
                continue
            if key[name]["kind"] == "one" and all(is_force(effect) for effect in effects):
                ((effect, size),) = effects.items()
                found[Row(effect, size, generator)].append(answer)
    return found


def line(row: Row, answers: list[dict[str, Any]]) -> str:
    """Return the line of one row."""
    consistent = [answer for answer in answers if answer["verdict"] == "consistent"]
    notes = [answer["immaterial"] for answer in consistent if answer["immaterial"]]
    shares = [entry["share"] for entries in notes for entry in entries]
    largest = f"{max(shares):.2%}" if shares else ""
    counts = (len(answers) - len(consistent), len(notes), len(consistent) - len(notes))
    cells = (f"{row.hidden} {row.size:g}", row.generator, *map(str, counts), largest)
    return "| " + " | ".join(cells) + " |"


if __name__ == "__main__":
    print(HEAD, "|---|---|---|---|---|---|", sep="\n")
    for _row, _answers in sorted(answers_by_row().items()):
        print(line(_row, _answers))
