/* The algorithm of the unit. Replace this file by yours.

   This one is simple. Its reference speed falls by at most 1.6 m/s2 and never below the fastest
   wheel. It holds the brake pressure of a wheel that slides by 5 %, and vents at 10 %. */

#include <string.h>

#include "unit.h"

static const double WHEEL_RADIUS_M = 0.445;
static const double FALL_M_S2 = 1.6;
static const double LEAST_SPEED_M_S = 1.5;    /* below this speed the brake acts freely */

void unit_start(Unit *unit)
{
    memset(unit, 0, sizeof *unit);
}

void unit_cycle(Unit *unit, double cycle_s)
{
    double reference_m_s = unit->reference_speed_m_s - FALL_M_S2 * cycle_s;
    for (int j = 0; j < AXLES; j++) {
        double speed_m_s = WHEEL_RADIUS_M * unit->wheel_speed_rad_s[j];
        if (speed_m_s > reference_m_s)
            reference_m_s = speed_m_s;
    }
    unit->reference_speed_m_s = reference_m_s;

    for (int j = 0; j < AXLES; j++) {
        double speed_m_s = WHEEL_RADIUS_M * unit->wheel_speed_rad_s[j];
        int acts = reference_m_s > LEAST_SPEED_M_S;
        unit->hold[j] = acts && speed_m_s < 0.95 * reference_m_s;
        unit->vent[j] = acts && speed_m_s < 0.90 * reference_m_s;
    }
}
