"""The answer on a public recording does not depend on how a logger writes it."""

import functools

import pytest
import recorder_variants as variants
from tiers import first_of

from rollerrig.rig.identify.train_recorder import recording, verdict


@functools.cache
def original(name):
    """Return the answer on a recording as it is."""
    return verdict.explain(recording.load(variants.MEASURED / name))


# fewest digits and samples, on change, and other marks
TELLING = ("1 km/h", "1 Hz", "on change", "semicolons")
FORMS = sorted(variants.FORMS, key=lambda form: form.name not in TELLING)


@pytest.mark.parametrize("form", first_of(FORMS, count=len(TELLING)), ids=lambda form: form.name)
@pytest.mark.parametrize("name", first_of(["comma_60s_mit", "obd_gap_mit"]))
def test_another_form_gives_the_same_answer_or_says_what_it_could_not_judge(name, form):
    source = variants.MEASURED / name
    if not variants.usable(source, form):
        return
    answer, problems = variants.compare(source, form, original(name))
    assert not problems, f"{answer}: {problems}"


@pytest.mark.nightly
def test_a_false_report_and_a_missing_one_are_contradictions():
    first = original("obd_gap_mit")
    gap = next(finding for finding in first.findings if finding.name == "sensor_dropout")
    radius = next(finding for finding in first.findings if finding.name == "wheel_radius")
    without = first._replace(findings=[gap])
    assert variants.contradictions(first, first) == []
    assert variants.contradictions(without, first)[0].startswith("new: wheel_radius")
    assert variants.contradictions(first, without)[0].startswith("missing: wheel_radius")
    other = radius._replace(size=3.0, low=2.9, high=3.1)
    moved = first._replace(findings=[gap, other])
    assert variants.contradictions(first, moved)[0].startswith("wheel_radius of")
