"""What lies on the running surfaces: sand on the rail, the contaminant on rollers.

A sander blows sand from its box through a hose onto the rail ahead of its wheel [S1]. The rail is a
row of cells that travels with the vehicle. Each wheel that rolls onto a cell meets its dose and
crushes a share of it [S2]; the next wheel meets the rest. No sand is lost in the balance: the sand
that left the boxes is in the hoses, lies on the rail, was blown aside, was crushed or lies behind
the vehicle.

    [S1] the hose holds back the sand by a lag: dm/dt = q - m / T, q the rate, or the dose times the
         speed
    [S2] D = sand of a cell / its length, a share of it is used up;
         ln mu_cd += gain (1 - exp(-D / D_0))

The contaminant on a roller is the same one turn after turn: each pass of the wheel thins it, and a
spray renews it [F1]. A wheel on a rail always meets fresh contaminant.

    [F1] a sector h of the roller loses a share of itself with each pass. It gains the film that the
         spray lays on it half a turn ahead of the wheel, up to the film that was prepared (1); the
         excess runs off. ln mu_cd += gain (1 - h)

Doubt: [S1] a real hose is closer to a pure delay; [S2] the form is an assumption, its numbers are
fitted to measured stops (`rollerrig validate sanding`). Sand brings a contact no further than its
clean limit.
"""

import math

from rollerrig.rig.compiled.kernel import kernel
from rollerrig.rig.state import CELLS, SECTORS

CELL_M = 0.2  # length of a cell of the rail
SHORTEST_DELAY_S = 1e-9  # of a hose: it must be above 0


@kernel
def begin(state, params):
    """Fill the boxes, clean the rail and prepare the rollers."""
    for j in range(state.axles):
        has_sander = (params.sanders.axles >> j) & 1
        state.sand_box[j] = params.sanders.box_kg if has_sander else 0.0
        state.rail_cell[j] = cell_at(state.position[0] - params.axle_position_m[j])
    state.rail_front[0] = cell_at(state.position[0] + params.sanders.ahead_m)
    for j in range(state.axles):
        state.film[j] = 1.0
    for i in range(state.axles * SECTORS):
        state.roller_film[i] = 1.0


@kernel
def cell_at(place_m):
    """Return the number of the cell of the rail that holds a place."""
    return math.floor(place_m / CELL_M)


@kernel
def advance_sand(state, sanders, positions_m, tick_s):
    """Let the sanders blow and the wheels roll on for a tick.

    `sanders` is `params.Sanders`, positions_m (4,) the distance of each wheelset behind the first.
    """
    # A new cell at the front takes the place of the last one in the ring, whose sand is left
    # behind.
    front = cell_at(state.position[0] + sanders.ahead_m)
    while state.rail_front[0] < front:
        state.rail_front[0] += 1.0
        at = int(state.rail_front[0]) % CELLS
        state.sand_left[0] += state.rail_sand[at]
        state.rail_sand[at] = 0.0

    for j in range(state.axles):
        place_m = state.position[0] - positions_m[j]
        if (sanders.axles >> j) & 1:
            run_sander(state, j, place_m + sanders.ahead_m, sanders, tick_s)
        roll_onto_cell(state, j, cell_at(place_m), sanders.used_share)


@kernel
def run_sander(state, j, place_m, sanders, tick_s):
    """Let the sander of axle j blow for a tick onto the rail at a place [S1]."""
    # from the box into the hose
    in_time = sanders.from_s <= state.time[0] < sanders.until_s
    commanded = state.sand_command[j] != 0.0 or in_time
    rate = sanders.rate_kg_s
    if sanders.dose_kg_m > 0.0:
        rate = min(rate, sanders.dose_kg_m * state.vehicle_speed[0])
    taken_kg = 0.0
    if commanded:
        taken_kg = min(rate * (1.0 + state.sand_rate_fault[j]) * tick_s, state.sand_box[j])
    state.sand_box[j] -= taken_kg
    state.sand_taken[j] += taken_kg
    state.sand_hose[j] += taken_kg

    # from the hose onto the rail, except the share that is blown aside
    delay_s = max(sanders.hose_delay_s + state.sand_delay_fault[j], SHORTEST_DELAY_S)
    out_kg = state.sand_hose[j] * -math.expm1(-tick_s / delay_s)
    state.sand_hose[j] -= out_kg
    state.sand_rate[j] = out_kg / tick_s
    state.sand_blown[0] += out_kg * sanders.lost_share
    state.rail_sand[int(cell_at(place_m)) % CELLS] += out_kg - out_kg * sanders.lost_share


@kernel
def roll_onto_cell(state, j, cell, used_share):
    """Let the wheels of axle j roll on to a cell: they meet all sand on the way [S2]."""
    new = cell - state.rail_cell[j]
    if new <= 0:
        return
    met_kg = 0.0
    first = int(cell - min(new, CELLS)) + 1
    for k in range(first, int(cell) + 1):
        here_kg = state.rail_sand[k % CELLS]
        met_kg += here_kg
        state.sand_used[j] += here_kg * used_share
        state.rail_sand[k % CELLS] = here_kg - here_kg * used_share
    state.sand_dose[j] = met_kg / (new * CELL_M)
    state.rail_cell[j] = cell


@kernel
def advance_films(state, film, tick_s):
    """Let the rollers turn for a tick under their wheels and their spray [F1].

    `film` is `params.RollerFilm`. All amounts are shares of the film of a whole prepared roller.
    """
    for j in range(state.axles):
        first = j * SECTORS
        sector = math.floor(state.roller_angle[j] * SECTORS / (2.0 * math.pi))

        # the spray, half a turn ahead of the wheel
        nozzle = first + (int(sector) + SECTORS // 2) % SECTORS
        laid = film.spray_1_s * tick_s
        room = (1.0 - state.roller_film[nozzle]) / SECTORS
        state.film_sprayed[j] += laid
        state.film_run_off[j] += max(laid - room, 0.0)
        state.roller_film[nozzle] += min(laid, room) * SECTORS

        # the wheel thins every sector that has passed under it in this tick
        new = sector - state.film_sector[j]
        oldest = int(sector - min(max(new, 0.0), SECTORS)) + 1
        for k in range(oldest, int(sector) + 1):
            at = first + k % SECTORS
            state.film[j] = state.roller_film[at]
            state.film_worn[j] += state.roller_film[at] * film.thinning / SECTORS
            state.roller_film[at] -= state.roller_film[at] * film.thinning
        state.film_sector[j] = max(sector, state.film_sector[j])
