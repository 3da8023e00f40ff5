"""Prints the sizes of sand in the kept answers, on which LEAST_SAND_AS_SECOND was set.

    cd tests; python -m generator.sand

One line for each kept set that hides sand or whose answer has sand: the generator, the set, what is
hidden, and the causes of the answer with their sizes. The limit was set on the first generator.
"""

from typing import Any

from generator import thresholds

SAND = "sanding"


def lines(generator: str, key: dict[str, Any], answers: dict[str, Any]) -> list[str]:
    """Return the lines of one generator."""
    found = []
    for name, answer in answers.items():
        hidden = key[name]["effects"]
        causes = {cause["name"]: cause for cause in answer["causes"]}
        if SAND not in hidden and SAND not in causes:
            continue
        sizes = []
        for cause_name, cause in causes.items():
            size = next(iter(cause["parameters"].values()))["value"]
            sizes.append(f"{cause_name} {size:.3g}")
        answered = ", ".join(sizes) or answer["verdict"]
        truth = ", ".join(f"{effect} {size:g}" for effect, size in hidden.items())
        found.append(f"{generator} {name}: hidden {truth or 'nothing'}; answer: {answered}")
    return found


if __name__ == "__main__":
    for _folder in thresholds.folders():
        print("\n".join(lines(*thresholds.read(_folder))))
