"""`rollerrig etcs`: Kdry_rst and Kwet_rst from campaigns on dry and on wet rails."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rollerrig.configs.errors import ConfigError
from rollerrig.realtime.commands import output

if TYPE_CHECKING:
    from rollerrig.realtime.campaign import etcs


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
        choices=("page", "osrd", "brake-models"),
        help="osrd: write osrd.json as well, the etcs_brake_params of a rolling stock of OSRD; "
        "brake-models: write brake_models.csv as well, a row for each combination of brakes and step "
        "of speed (default: page)",
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
    from rollerrig.realtime.campaign import combined, etcs
    from rollerrig.realtime.reports import pdf
    from rollerrig.realtime.reports.statistics import brake_models, osrd
    from rollerrig.realtime.reports.statistics import etcs as etcs_report

    if options.pdf:
        pdf.check()
    if not 0.0 <= options.available_adhesion <= 1.0:
        raise ConfigError(
            f"--available-adhesion {options.available_adhesion:g}: allowed are 0 to 1"
        )
    train = _train(options)
    names = combined.names_in(options.dry)
    tables = {}
    files: list[Path] = []
    out = options.out or options.dry
    for name in names or ("",):
        table = etcs.table(
            etcs.sample(options.dry / name), _wet(options, name), options.available_adhesion
        )
        tables[name or "all"] = table
        files += etcs_report.write(table, out / name, options.pdf)
        if train is not None:
            files.insert(0, osrd.write(osrd.parameters(table, options.ebcl, train), out / name))
    if options.format == "brake-models":
        files.insert(0, brake_models.write(tables, out))
    result = next(iter(tables.values()))
    if names:
        result = {combined.TABLE: tables}
    title = "Kdry_rst (lower bound) and Kwet_rst"
    items: list[Any] = []
    for name, table in tables.items():
        # a terminal is too narrow for a column per confidence level: here each level is a row
        head, *rows = zip(etcs_report.HEAD, *etcs_report.rows(table), strict=True)
        items.append((f"{title} [{name}]" if names else title, head, rows))
    return output.show(
        options,
        result | {"files": [str(file) for file in files]},
        *items,
        etcs.NOT_A_CERTIFICATE,
        f"report: {files[-1]}",
    )


def _train(options: argparse.Namespace) -> dict[str, float] | None:
    """Return the values for OSRD that no campaign knows; None for other formats."""
    from rollerrig.realtime.campaign.statistics import corrections
    from rollerrig.realtime.reports.statistics import osrd

    if options.format != "osrd":
        if options.train is not None:
            raise ConfigError("--train is for --format osrd; add it, or remove --train")
        return None
    if options.ebcl not in corrections.LEVELS:
        raise ConfigError(f"--ebcl {options.ebcl}: allowed are 0 to 9")
    if options.train is None:
        names = ", ".join(row.name for row in osrd.ROWS)
        raise ConfigError(
            "--format osrd needs --train FILE, a TOML file with what no campaign knows: " + names
        )
    return osrd.read(options.train)


def _wet(options: argparse.Namespace, name: str) -> "etcs.Sample | None":
    """Return the campaign on wet rails of a combination: in its folder, or one for all."""
    from rollerrig.realtime.campaign import combined, etcs

    if not options.wet:
        return None
    names = combined.names_in(options.wet)
    if names and name not in names:
        raise ConfigError(
            f"{options.wet}: has the combinations {', '.join(names)}, and not {name or 'one for all'}; "
            "give both plans the same combinations"
        )
    return etcs.sample(options.wet / name if names else options.wet)
