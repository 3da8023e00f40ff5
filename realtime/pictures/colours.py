"""The colours of every view, picture and report, as red, green and blue from 0 to 255.

Source: the palette of Okabe and Ito, which colour-blind people can distinguish. One colour means
one axle, or one model, in Rerun and on pages. Both have a light and a dark background.
"""

from rollerrig.configs.vehicle import MOST_AXLES, MOST_CARS

Colour = tuple[int, int, int]

# the palette
ORANGE = (230, 159, 0)
SKY_BLUE = (86, 180, 233)
GREEN = (0, 158, 115)
YELLOW = (240, 228, 66)
BLUE = (0, 114, 178)
VERMILION = (213, 94, 0)
PURPLE = (204, 121, 167)

# additions to the palette that are visible on white and on black
GREY = (140, 140, 140)
STEEL = (145, 145, 150)
OLIVE = (175, 170, 0)
BROWN = (150, 110, 85)

# axles of the leading group, 1 to 4
_GROUP = (SKY_BLUE, ORANGE, GREEN, PURPLE)
# how much darker the colours of each further group are
_SHADES = (1.0, 0.72, 0.5)


def _shaded(colour: Colour, share: float) -> Colour:
    red, green, blue = colour
    return round(share * red), round(share * green), round(share * blue)


# of as many axles as a vehicle may have: an axle of a further group has the colour of the same axle
# of the leading group, darker
AXLES = tuple(
    _shaded(_GROUP[axle % len(_GROUP)], _SHADES[axle // len(_GROUP)]) for axle in range(MOST_AXLES)
)

# the lines of the axles of a group, as lengths of dashes and gaps in points; () is a solid line
_GROUP_DASHES: tuple[tuple[float, ...], ...] = ((), (7, 2), (4, 2, 1, 2), (2, 2))
# those of all axles: colour is never the only mark of an axle
AXLE_DASHES = tuple(_GROUP_DASHES[axle % len(_GROUP)] for axle in range(MOST_AXLES))

# cars of a train, as many as it may have: each further six are darker
_CARS = (BLUE, ORANGE, GREEN, PURPLE, SKY_BLUE, VERMILION)
CARS = tuple(
    _shaded(_CARS[car % len(_CARS)], _SHADES[car // len(_CARS)]) for car in range(MOST_CARS)
)
# kinds of lines of the cars, as lengths of dashes and gaps in points
CAR_DASHES: tuple[tuple[float, ...], ...] = tuple(
    ((), (6, 2), (2, 2))[car // len(_CARS)] for car in range(MOST_CARS)
)

VEHICLE = STEEL
# what a signal is compared with: the reference speed of the WSP unit, the brake demand
REFERENCE = OLIVE
# the limits of adhesion
LIMIT = BROWN

# name and colour of each state of a dump valve; a state is its place in this table
VALVE_STATES = (
    ("fill", (120, 130, 140)),
    ("hold", YELLOW),
    ("vent", VERMILION),
)

# measured values, and the two models of an explanation; a report draws MEASURED in its text colour
MEASURED = STEEL
BASE = VERMILION
EXTENDED = BLUE


def as_hex(colour: Colour) -> str:
    """Return a colour in the notation of HTML and matplotlib, for example #0072b2."""
    return f"#{bytes(colour).hex()}"
