"""The block diagram of rig, buses and unit, as SVG with text; `make pictures` writes it."""

from html import escape
from typing import NamedTuple

from rollerrig.configs.vehicle import COACH
from rollerrig.wsp_interface import signals

TABLE = signals.table(COACH)

WIDTH, HEIGHT = 830, 500
FONT = "font-family='system-ui,-apple-system,Segoe UI,Helvetica,Arial,sans-serif'"
LINE = 17  # height of a line of text


class Look(NamedTuple):
    """The colours of a diagram."""

    text: str
    quiet: str
    line: str
    block: str
    unit: str
    rig: str


LIGHT = Look("#1f2328", "#59636e", "#8c959f", "#f6f8fa", "#fff1d6", "#e3f1ec")
DARK = Look("#e6edf3", "#9198a1", "#6e7681", "#161b22", "#3a2c0f", "#10302a")


class Diagram:
    """An SVG that grows by blocks, lines and texts."""

    def __init__(self, look):
        self.look = look
        self.parts = []

    def block(self, left, top, width, height, title, lines=(), fill=""):
        """Add a block with a title and further lines, in the middle of it."""
        self.parts.append(
            f"<rect x='{left}' y='{top}' width='{width}' height='{height}' rx='6' "
            f"fill='{fill or self.look.block}' stroke='{self.look.line}'/>"
        )
        middle = left + width / 2
        first = top + height / 2 - LINE * len(lines) / 2 + 5
        self.text(middle, first, title, bold=True)
        for place, line in enumerate(lines, start=1):
            self.text(middle, first + place * LINE, line, quiet=True)

    def text(self, x, y, text, bold=False, quiet=False):
        """Add a line of text."""
        weight = " font-weight='600'" if bold else ""
        colour = self.look.quiet if quiet else self.look.text
        size = 12.5 if quiet else 14
        self.parts.append(
            f"<text x='{x}' y='{y}' text-anchor='middle' font-size='{size}'{weight} "
            f"fill='{colour}'>{escape(text)}</text>"
        )

    def bus(self, top):
        """Add a bus, from the left to the right."""
        self.parts.append(
            f"<path d='M20 {top}H{WIDTH - 20}' stroke='{self.look.text}' stroke-width='4'/>"
        )

    def link(self, x, top, bottom):
        """Add a vertical line with arrows at both ends."""
        self._arrow(f"M{x} {top + 4}V{bottom - 4}", both=True)

    def flow(self, x, top, bottom):
        """Add an arrow downwards."""
        self._arrow(f"M{x} {top + 4}V{bottom - 4}", both=False)

    def flow_right(self, left, right, y):
        """Add an arrow to the right."""
        self._arrow(f"M{left + 4} {y}H{right - 4}", both=False)

    def _arrow(self, path, both):
        start = " marker-start='url(#head)'" if both else ""
        self.parts.append(
            f"<path d='{path}' stroke='{self.look.line}' stroke-width='1.5'{start} "
            "marker-end='url(#head)'/>"
        )

    def svg(self, title):
        """Return the drawing."""
        return (
            f"<svg xmlns='http://www.w3.org/2000/svg' viewBox='0 0 {WIDTH} {HEIGHT}' "
            f"width='{WIDTH}' height='{HEIGHT}' {FONT}>\n<title>{escape(title)}</title>\n"
            "<defs><marker id='head' viewBox='0 0 8 8' refX='7' refY='4' markerWidth='5' "
            f"markerHeight='5' orient='auto-start-reverse'><path d='M0 0L8 4L0 8z' "
            f"fill='{self.look.line}'/></marker></defs>\n" + "\n".join(self.parts) + "\n</svg>\n"
        )


def block_diagram(dark):
    """Return the block diagram of rig, buses and unit as SVG, in light or dark."""
    diagram = Diagram(DARK if dark else LIGHT)
    look = diagram.look
    drives = f"nodes {TABLE.drive_nodes[0]} to {TABLE.drive_nodes[-1]}"

    # who is on the bus from outside
    diagram.block(
        20,
        20,
        225,
        84,
        "WSP unit under test",
        (f"node {signals.WSP_NODE}: yours, an FMU,", "or the reference unit"),
        look.unit,
    )
    diagram.block(
        265,
        20,
        225,
        84,
        "Test harness",
        ("sequence, pytest, Robot,", "Python, your program"),
    )
    diagram.block(
        510,
        20,
        300,
        84,
        "Your tools",
        ("candump, CANoe, a logger: socketcand,", "SocketCAN, slcan, cannelloni"),
    )
    for x in (132, 377, 660):
        diagram.link(x, 104, 150)
    diagram.bus(150)
    diagram.text(518, 138, "CAN, SYNC every 10 ms", quiet=True)

    # the devices of the rig
    devices = (
        ("Roller drives", (drives, "CiA 402")),
        ("Axle speeds", (f"node {signals.SPEED_NODE}", "CiA 406")),
        ("Brake I/O", (f"node {signals.BRAKE_NODE}: magnets,", "pressures, CiA 401")),
        ("Sanders", (f"node {signals.SANDER_NODE}", "CiA 401")),
        ("Bench", (f"node {signals.BENCH_NODE}: NMT,", "SYNC, faults, figures")),
    )
    width = 146
    for place, (title, lines) in enumerate(devices):
        left = 20 + place * (width + 15)
        diagram.link(left + width / 2, 150, 190)
        diagram.block(left, 190, width, 76, title, lines)
        diagram.link(left + width / 2, 266, 300)

    # the rig
    diagram.block(
        20,
        300,
        WIDTH - 40,
        76,
        "Simulated rig: one real-time loop, 1 kHz, physics at 10 kHz",
        (
            "rollers and motors  ·  wheel and roller contact with adhesion that recovers  ·  "
            "cylinders and dump valves",
            "vehicle with load transfer, or in 3D  ·  faults",
        ),
        look.rig,
    )

    # what is around the loop
    diagram.link(135, 376, 410)
    diagram.flow(405, 376, 410)
    diagram.block(
        20,
        410,
        250,
        76,
        "Supervisory PLC",
        ("Modbus TCP, RTU, TLS: the desk", "in a browser, or a PLC"),
    )
    diagram.block(
        290, 410, 230, 76, "Recorder", ("run folder: channels, events,", "bus log, Rerun recording")
    )
    diagram.block(
        560, 410, 250, 76, "Reports", ("verdicts, campaigns,", "explanation of measured stops")
    )
    diagram.flow_right(520, 560, 448)
    return diagram.svg("rollerrig: the unit under test, the bus, the devices, the simulated rig")
