"""The colours of every view, picture and report, as red, green and blue from 0 to 255.

They are Okabe and Ito's, safe for the colour-blind. One colour means one axle, or one model,
wherever it is drawn: in Rerun and on pages, both of which are light or dark.
"""

Colour = tuple[int, int, int]

ORANGE, SKY_BLUE, GREEN, YELLOW = (230, 159, 0), (86, 180, 233), (0, 158, 115), (240, 228, 66)
BLUE, VERMILION, PURPLE, GREY = (0, 114, 178), (213, 94, 0), (204, 121, 167), (140, 140, 140)
# what is measured, and the vehicle, seen on white and on black; in a report the colour of its text
STEEL, OLIVE, BROWN = (145, 145, 150), (175, 170, 0), (150, 110, 85)

AXLES = (SKY_BLUE, ORANGE, GREEN, PURPLE)
VEHICLE, REFERENCE, LIMIT = STEEL, OLIVE, BROWN
VALVE_STATES = (("fill", (120, 130, 140)), ("hold", YELLOW), ("vent", VERMILION))
MEASURED, BASE, EXTENDED = STEEL, VERMILION, BLUE


def on_page(colour: Colour) -> str:
    """A colour as HTML and matplotlib write it, as in #0072b2."""
    return f"#{bytes(colour).hex()}"
