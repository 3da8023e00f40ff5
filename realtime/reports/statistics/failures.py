"""The part of a campaign's page about failures: their laws, and how far each combination goes."""

import math
from collections import defaultdict

import numpy as np

from rollerrig.realtime.campaign import campaign
from rollerrig.realtime.campaign.outcome import Outcome
from rollerrig.realtime.campaign.statistics import strata
from rollerrig.realtime.reports import page

# combinations in the table at most
_MOST_ROWS = 40
# numbers below this one are shown as one in so many
_FEW = 1e-3


def parts(plan: campaign.Plan, outcome: Outcome) -> list[page.Markup]:
    """Return the part of the page; it is empty for a plan without failures and strata."""
    found: list[page.Markup] = []
    if plan.applied is not None and plan.applied.failures:
        rows = [
            (
                failure.name.replace("_", " "),
                failure.law,
                percent(failure.kind.probability),
                failure.source,
            )
            for failure in plan.applied.failures
        ]
        found += [
            page.element("h2", "Failures"),
            page.table(("component", "places and law", "probability at a stop", "source"), rows),
        ]
    if isinstance(outcome.distance_m, strata.Sample):
        found += _combinations(outcome.distance_m)
    return found


def _combinations(distance_m: strata.Sample) -> list[page.Markup]:
    """Return the table of the combinations of failures, the most probable first."""
    members: dict[int, list[int]] = defaultdict(list)
    for place, stratum in enumerate(distance_m.strata):
        members[stratum.group].append(place)
    rows = []
    for places in members.values():
        chosen = np.isin(distance_m.stratum, places)
        values_m = distance_m.values[chosen]
        if not values_m.size:
            continue
        weights = distance_m.weights[chosen]
        finite = np.isfinite(values_m)
        mean = "-"
        if finite.any():
            mean = f"{np.average(values_m[finite], weights=weights[finite]):.1f}"
        longest = f"{values_m[0]:.1f}" if math.isfinite(values_m[0]) else "not stopped"
        probability = math.fsum(distance_m.strata[place].probability for place in places)
        text = distance_m.strata[places[0]].text
        rows.append((probability, (text, percent(probability), str(values_m.size), mean, longest)))
    rows.sort(key=lambda row: -row[0])
    shown = [cells for _, cells in rows[:_MOST_ROWS]]
    left_out = max(len(rows) - _MOST_ROWS, 0)
    found = [
        page.element("h2", "Combinations of failures"),
        page.table(
            ("failed", "probability", "runs", "mean distance, m", "longest distance, m"), shown
        ),
    ]
    if left_out:
        found.append(
            page.paragraph(f"{left_out} less probable combinations are not in this table.")
        )
    return found


def percent(share: float) -> str:
    """Return a share for a reader: in percent, or as one in so many; never with an exponent."""
    if share == 0.0 or share >= _FEW:
        digits = 0
        # as many nines as a quantile close to 1 has
        if 0.9 < share < 1.0:
            digits = max(math.ceil(-math.log10(1.0 - share) - 1e-9) - 2, 0)
        elif share < 0.1:
            digits = 2
        text = f"{100 * share:.{digits}f}"
        return f"{text.rstrip('0').rstrip('.') if '.' in text else text} %"
    return f"1 in {1.0 / share:,.0f}"
