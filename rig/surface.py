"""What lies on the running surfaces: sand on the rail, the contaminant on rollers.

A sander blows sand from its box through a hose onto the rail ahead of its wheel [S1]. The rail is a row of cells that
travels with the vehicle; each wheel that rolls onto a cell meets its dose and crushes a share of it [S2], the next
wheel meets the rest. No gram is lost: what the boxes gave lies in hoses and on the rail, was blown aside, crushed or
left behind.

    [S1] the hose holds back what is blown into it by a lag: dm/dt = q - m / T, q the rate or the dose times the speed
    [S2] D = cell / its length, a share of it is used up; ln mu_cd += gain (1 - exp(-D / D_0))

The contaminant on a roller is the same one turn after turn: each pass of the wheel thins it, a spray renews it [F1],
where a wheel on a rail meets a fresh one always.

    [F1] a sector h of the roller loses a share of itself with each pass and gains what the spray lays on it, up to what
         was prepared (1), half a turn ahead of the wheel; what is more runs off. ln mu_cd += gain (1 - h)

Doubt: [S1] a pure delay is rather what a hose does; [S2] the form is an assumption, its numbers are fitted to stops
that were measured (`tests/paper/sanding.py`). Sand brings a contact no further than its clean limit.
"""

import math

from rollerrig.rig.compiled.kernel import kernel
from rollerrig.rig.state import AXLES, CELLS, SECTORS

CELL_M = 0.2


@kernel
def begin(state, params):
    """Fill the boxes, clean the rail and prepare the rollers."""
    for j in range(AXLES):
        state.sand_box[j] = params.sanders.box_kg if (params.sanders.axles >> j) & 1 else 0.0
        state.rail_cell[j] = cell_at(state.position[0] - params.axle_position_m[j])
    state.rail_front[0] = cell_at(state.position[0] + params.sanders.ahead_m)
    for j in range(AXLES):
        state.film[j] = 1.0
    for i in range(AXLES * SECTORS):
        state.roller_film[i] = 1.0


@kernel
def cell_at(place_m):
    """The number of the cell of the rail that holds a place."""
    return math.floor(place_m / CELL_M)


@kernel
def strew(state, sanders, positions_m, tick_s):
    """Let sanders strew and wheels roll on for a tick."""
    front = cell_at(state.position[0] + sanders.ahead_m)
    while (
        state.rail_front[0] < front
    ):  # the cell that comes in was the last one: what lies there stays behind
        state.rail_front[0] += 1.0
        at = int(state.rail_front[0]) % CELLS
        state.sand_left[0] += state.rail_sand[at]
        state.rail_sand[at] = 0.0
    for j in range(AXLES):
        place_m = state.position[0] - positions_m[j]
        if (sanders.axles >> j) & 1:
            blow(state, j, place_m + sanders.ahead_m, sanders, tick_s)
        meet(state, j, cell_at(place_m), sanders.used_share)


@kernel
def blow(state, j, place_m, sanders, tick_s):
    """Let the sander of an axle blow for a tick onto the rail at a place [S1]."""
    asked = state.sand_command[j] != 0.0 or sanders.from_s <= state.time[0] < sanders.until_s
    rate = sanders.rate_kg_s
    if sanders.dose_kg_m > 0.0:
        rate = min(rate, sanders.dose_kg_m * state.vehicle_speed[0])
    taken_kg = (
        min(rate * (1.0 + state.sand_rate_fault[j]) * tick_s, state.sand_box[j]) if asked else 0.0
    )
    state.sand_box[j] -= taken_kg
    state.sand_taken[j] += taken_kg
    state.sand_hose[j] += taken_kg
    out_kg = state.sand_hose[j] * -math.expm1(
        -tick_s / max(sanders.hose_delay_s + state.sand_delay_fault[j], 1e-9)
    )
    state.sand_hose[j] -= out_kg
    state.sand_rate[j] = out_kg / tick_s
    state.sand_blown[0] += out_kg * sanders.lost_share
    state.rail_sand[int(cell_at(place_m)) % CELLS] += out_kg - out_kg * sanders.lost_share


@kernel
def meet(state, j, cell, used_share):
    """Let the wheels of an axle roll on to a cell [S2]."""
    new = cell - state.rail_cell[j]
    if new <= 0:
        return
    met_kg = 0.0
    for k in range(int(cell - min(new, CELLS)) + 1, int(cell) + 1):
        here_kg = state.rail_sand[k % CELLS]
        met_kg += here_kg
        state.sand_used[j] += here_kg * used_share
        state.rail_sand[k % CELLS] = here_kg - here_kg * used_share
    state.sand_dose[j] = met_kg / (new * CELL_M)
    state.rail_cell[j] = cell


@kernel
def turn(state, film, tick_s):
    """Let rollers turn for a tick under their wheels and their spray [F1]."""
    for j in range(AXLES):
        first = j * SECTORS
        sector = math.floor(state.roller_angle[j] * SECTORS / (2.0 * math.pi))
        # all in shares of what a whole roller carries when it is prepared
        nozzle = first + (int(sector) + SECTORS // 2) % SECTORS
        laid = film.spray_1_s * tick_s
        room = (1.0 - state.roller_film[nozzle]) / SECTORS
        state.film_sprayed[j] += laid
        state.film_run_off[j] += max(laid - room, 0.0)
        state.roller_film[nozzle] += min(laid, room) * SECTORS
        new = sector - state.film_sector[j]
        for k in range(int(sector - min(max(new, 0.0), SECTORS)) + 1, int(sector) + 1):
            at = first + k % SECTORS
            state.film[j] = state.roller_film[at]
            state.film_worn[j] += state.roller_film[at] * film.thinning / SECTORS
            state.roller_film[at] -= state.roller_film[at] * film.thinning
        state.film_sector[j] = max(sector, state.film_sector[j])
