"""Runs of trains by the command line, and what differs between their records."""

import json

from rollerrig.realtime import cli
from rollerrig.realtime.commands import output
from rollerrig.realtime.record import channels


def run(folder, capsys, *words):
    """Run a train into a folder; return its summary."""
    status = cli.main(["run", *words, "--json", "--out", str(folder)])
    printed = capsys.readouterr()
    assert status == output.PASS, printed.err
    return json.loads(printed.out)


def differing(first, second):
    """Return the channels of two records that are not equal to the bit."""
    a, b = (channels.load(folder) for folder in (first, second))
    assert a.column_names == b.column_names
    return [
        name
        for name in a.column_names
        if a[name].to_numpy().tobytes() != b[name].to_numpy().tobytes()
    ]
