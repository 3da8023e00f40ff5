"""`rollerrig etcs`: Kdry_rst and Kwet_rst from campaigns on dry and on wet rails."""

import argparse
from pathlib import Path

from rollerrig.configs.errors import ConfigError
from rollerrig.realtime.commands import output


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `rollerrig etcs`."""
    parser.add_argument("dry", type=Path, metavar="DRY", help="result folder on dry rails")
    parser.add_argument(
        "wet", type=Path, metavar="WET", nargs="?", help="result folder on wet rails, for Kwet_rst"
    )
    parser.add_argument(
        "--out",
        type=Path,
        metavar="DIR",
        help="folder of etcs.json, etcs.csv and etcs.html (default: DRY)",
    )
    parser.add_argument(
        "--available-adhesion",
        type=float,
        default=0.0,
        metavar="SHARE",
        help="M_NVAVADH, the weight of available adhesion, from 0 to 1 (default: 0)",
    )
    parser.add_argument(
        "--pdf", action="store_true", help="write the page as PDF as well (etcs.pdf)"
    )


def call(options: argparse.Namespace) -> int:
    """Write the correction factors of two campaigns, and print them. Raises ConfigError."""
    from rollerrig.realtime.campaign import etcs
    from rollerrig.realtime.reports import pdf
    from rollerrig.realtime.reports.statistics import etcs as etcs_report

    if options.pdf:
        pdf.check()
    if not 0.0 <= options.available_adhesion <= 1.0:
        raise ConfigError(
            f"--available-adhesion {options.available_adhesion:g}: allowed are 0 to 1"
        )
    dry = etcs.sample(options.dry)
    wet = etcs.sample(options.wet) if options.wet else None
    table = etcs.table(dry, wet, options.available_adhesion)
    out = options.out or options.dry
    files = etcs_report.write(table, out, options.pdf)
    # a terminal is too narrow for a column per confidence level: here each level is a row
    head, *rows = zip(etcs_report.HEAD, *etcs_report.rows(table), strict=True)
    return output.show(
        options,
        table | {"files": [str(file) for file in files]},
        ("Kdry_rst (lower bound) and Kwet_rst", head, rows),
        etcs.NOT_A_CERTIFICATE,
        f"report: {files[-1]}",
    )
