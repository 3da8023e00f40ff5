/* A WSP unit for one group of four axles: what fmi2_unit.c needs of the algorithm in unit.c. */

#define AXLES 4

typedef struct {
    /* inputs, in the order of modelDescription.xml */
    double wheel_speed_rad_s[AXLES];

    /* outputs */
    int hold[AXLES];    /* 1: the hold magnet has current */
    int vent[AXLES];    /* 1: the vent magnet has current */
    double reference_speed_m_s;
} Unit;

/* Return the unit to the state before its first cycle. */
void unit_start(Unit *unit);

/* Run one cycle of the unit; it lasts cycle_s seconds. */
void unit_cycle(Unit *unit, double cycle_s);
