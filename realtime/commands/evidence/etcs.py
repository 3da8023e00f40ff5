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
        "--format",
        default="page",
        choices=("page", "osrd"),
        help="osrd: write osrd.json as well, the etcs_brake_params of a rolling stock of OSRD "
        "(default: page)",
    )
    parser.add_argument(
        "--ebcl",
        type=int,
        default=9,
        metavar="LEVEL",
        help="confidence level M_NVEBCL of osrd.json, from 0 to 9 (default: 9)",
    )
    parser.add_argument(
        "--train",
        type=Path,
        metavar="FILE",
        help="TOML file with what OSRD needs and no campaign knows: service decelerations and times",
    )
    parser.add_argument(
        "--pdf", action="store_true", help="write the page as PDF as well (etcs.pdf)"
    )


def call(options: argparse.Namespace) -> int:
    """Write the correction factors of two campaigns, and print them. Raises ConfigError."""
    from rollerrig.realtime.campaign import etcs
    from rollerrig.realtime.campaign.statistics import corrections
    from rollerrig.realtime.reports import pdf
    from rollerrig.realtime.reports.statistics import etcs as etcs_report
    from rollerrig.realtime.reports.statistics import osrd

    if options.pdf:
        pdf.check()
    if not 0.0 <= options.available_adhesion <= 1.0:
        raise ConfigError(
            f"--available-adhesion {options.available_adhesion:g}: allowed are 0 to 1"
        )
    train = None
    if options.format == "osrd":
        if options.ebcl not in corrections.LEVELS:
            raise ConfigError(f"--ebcl {options.ebcl}: allowed are 0 to 9")
        if options.train is None:
            names = ", ".join(row.name for row in osrd.ROWS)
            raise ConfigError(
                "--format osrd needs --train FILE, a TOML file with what no campaign knows: "
                + names
            )
        train = osrd.read(options.train)
    elif options.train is not None:
        raise ConfigError("--train is for --format osrd; add it, or remove --train")
    dry = etcs.sample(options.dry)
    wet = etcs.sample(options.wet) if options.wet else None
    table = etcs.table(dry, wet, options.available_adhesion)
    out = options.out or options.dry
    files = etcs_report.write(table, out, options.pdf)
    if train is not None:
        files.insert(0, osrd.write(osrd.parameters(table, options.ebcl, train), out))
    # a terminal is too narrow for a column per confidence level: here each level is a row
    head, *rows = zip(etcs_report.HEAD, *etcs_report.rows(table), strict=True)
    return output.show(
        options,
        table | {"files": [str(file) for file in files]},
        ("Kdry_rst (lower bound) and Kwet_rst", head, rows),
        etcs.NOT_A_CERTIFICATE,
        f"report: {files[-1]}",
    )
