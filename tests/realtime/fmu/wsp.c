/* Rules of an earlier reference WSP in C, as an FMU for co-simulation: FMI 3, or FMI 2 with -DFMI2, or a CAN node with
   -DLS_BUS. It trusts each sensor that is not stuck, its band does not narrow and its pulses have one length, so it does
   not brake as the present reference WSP does.
   parameters.h is written by the tests from the packaged configuration and the tables of firmware_sim/wsp/phases.py.
   FAIL_AT_S, HANG_AT_S, CRASH_AT_S: what goes wrong, and when; with -DSEGFAULT a crash writes where no memory is. */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "parameters.h"

/* what a wheel speed is given in, in rad/s */
#ifndef SPEED_UNIT
#define SPEED_UNIT 1.0
#endif

#ifdef SEGFAULT
#define CRASH *(volatile int *)0 = 0
#else
#define CRASH abort()
#endif

enum { FILL, STEP_FILL, HOLD, STEP_VENT, VENT, RUN_UP, LOCKED_OUT };
enum { E_VENT = 4, E_RUN_UP = 5, E_TIMER = 6, E_CUT_OFF = 7 };
#define NOBODY -1

typedef struct {
    double in[8];       /* wheel speeds in rad/s, cylinder pressures in Pa */
    int hold[4], vent[4];
    double reference, time;
    /* memory of the rules */
    double cycles, speed[4], lagged[4], slope[4], falling[4], deceleration, anchored, anchor_age, calm, run_ups;
    double sliding[4], same[4], phase_age[4], vent_age[4], hold_age[4];
    long raw[4];
    int runner, phase[4];
} Wsp;

static int passed(double cycles, double duration) { return (cycles + 0.5) * CYCLE_S >= duration; }
static int stuck(const Wsp *w, int j) { return passed(w->same[j], STUCK_S); }
static double least(double a, double b) { return a < b ? a : b; }
static double most(double a, double b) { return a > b ? a : b; }

static void measure(Wsp *w, const long *counts)
{
    int changed = 0;
    for (int j = 0; j < 4; j++) {
        double v = fabs((double)counts[j]) * SPEED_SCALE * 0.5 * DIAMETER[j];
        if (w->cycles == 0.0) w->lagged[j] = v;
        w->speed[j] = v;
        w->slope[j] = (v - w->lagged[j]) / ACCELERATION_FILTER_S;
        w->lagged[j] += w->slope[j] * CYCLE_S;
        w->falling[j] = w->slope[j] < -FALL_M_S2 ? w->falling[j] + 1.0 : 0.0;
    }
    for (int j = 0; j < 4; j++) changed += counts[j] != w->raw[j];
    for (int j = 0; j < 4; j++) {
        if (counts[j] != w->raw[j] || counts[j] == 0) w->same[j] = 0.0;
        else if (changed > 1) w->same[j] += 1.0;
        w->raw[j] = counts[j];
    }
    for (int j = 0; j < 4; j++)
        if (stuck(w, j) && !stuck(w, j ^ 1)) {
            w->speed[j] = w->speed[j ^ 1];
            w->slope[j] = w->slope[j ^ 1];
        }
}

static void advance(Wsp *w)
{
    double fastest = 0.0, fall = REFERENCE_FALL_M_S2, before;
    int sliding = 0;
    for (int j = 0; j < 4; j++) {
        if (!stuck(w, j)) fastest = most(fastest, w->speed[j]);
        sliding |= w->phase[j] != FILL || passed(w->falling[j], CONFIRM_S);
    }
    if (w->cycles == 0.0) {
        w->reference = fastest;
        w->deceleration = FIRST_DECELERATION_M_S2;
        w->runner = NOBODY;
    }
    if (sliding) fall = least(fall, w->deceleration + DECELERATION_MARGIN_M_S2);
    before = w->reference;
    w->reference = least(most(before - fall * CYCLE_S, fastest), before + REFERENCE_RISE_M_S2 * CYCLE_S);
    w->anchor_age += 1.0;
    w->calm = sliding ? 0.0 : w->calm + 1.0;
    if (passed(w->calm, CALM_S)) {
        w->anchored = w->reference;
        w->anchor_age = w->run_ups = 0.0;
    }
}

static void choose_runner(Wsp *w)
{
    if (w->reference < CUT_OFF_M_S) {
        w->runner = NOBODY;
        return;
    }
    if (w->runner != NOBODY && stuck(w, w->runner)) w->runner = NOBODY;
    if (w->runner == NOBODY && passed(w->anchor_age, w->run_ups == 0.0 ? RUN_UP_FIRST_S : RUN_UP_INTERVAL_S)) {
        int chosen = 3 - (int)w->run_ups % RUN_UP_AXLES;
        if (!stuck(w, chosen)) w->runner = chosen;
        w->run_ups += 1.0;
    }
}

static void finish_run_up(Wsp *w)
{
    int j = w->runner;
    if (j < 0 || w->phase[j] != RUN_UP) return;
    if (passed(w->phase_age[j], RUN_UP_SHORTEST_S) && w->slope[j] < RUN_UP_DONE_M_S2) {
        double elapsed = w->anchor_age * CYCLE_S, mean = (w->anchored - w->speed[j]) / elapsed;
        double trust = elapsed / (elapsed + LEARNING_S);
        double learned = w->deceleration + trust * (mean - w->deceleration);
        w->deceleration = least(most(learned, 0.0), REFERENCE_FALL_M_S2);
        w->reference = w->anchored = w->speed[j];
        w->anchor_age = 0.0;
    } else if (passed(w->phase_age[j], RUN_UP_LONGEST_S)) {
        w->anchored = w->reference;
        w->anchor_age = 0.0;
    } else {
        return;
    }
    w->runner = NOBODY;
}

static int event_of(Wsp *w, int j)
{
    double v = w->reference, s = w->sliding[j] = v - w->speed[j], a = w->slope[j];
    double begin = SLIDE_BEGIN_M_S + SLIDE_BEGIN_FRACTION * v;
    double low = least(BAND_LOW_M_S, BAND_LOW_FRACTION * v), high = least(BAND_HIGH_M_S, BAND_HIGH_FRACTION * v);
    int row = (s > begin) + (s > low) + (s > high) + (s > high * DEEP_FACTOR);
    int column = (a > -FAST_FALL_M_S2) + (a > -FALL_M_S2) + (a > RISE_M_S2) + (a > FAST_RISE_M_S2);
    int event = WISHES[row][column];
    if (w->runner == j) event = E_RUN_UP;
    if (stuck(w, j)) event = E_VENT;
    if (passed(w->vent_age[j], VENT_TIMER_S) || passed(w->hold_age[j], HOLD_TIMER_S)) event = E_TIMER;
    if (v < CUT_OFF_M_S) event = E_CUT_OFF;
    return event;
}

static void act(Wsp *w, int j, int event)
{
    const double pulse[] = {0.0, FILL_PULSE_S, 0.0, VENT_PULSE_S, 0.0, 0.0, LOCK_OUT_S};
    const double pause[] = {0.0, FILL_PAUSE_S, 0.0, VENT_PAUSE_S, 0.0, 0.0, 0.0};
    int phase = w->phase[j], following = NEXT[phase][event], magnets;
    int over = passed(w->phase_age[j], pulse[phase] + pause[phase]);
    if ((over || INTERRUPTS[phase][event]) && (following != phase || pulse[phase] > 0.0)) {
        phase = following;
        w->phase_age[j] = 0.0;
    }
    w->phase[j] = phase;
    magnets = MAGNETS[phase][passed(w->phase_age[j], pulse[phase])];
    w->phase_age[j] += 1.0;
    w->hold[j] = magnets & 1;
    w->vent[j] = magnets >> 1;
    w->vent_age[j] = magnets == 0 ? 0.0 : w->vent_age[j] + (w->vent[j] != 0);
    w->hold_age[j] = magnets == 0 ? 0.0 : w->hold_age[j] + (w->vent[j] == 0);
}

#ifdef LAST_WORDS
/* a library that prints when the process exits */
__attribute__((destructor)) static void leave(void) { printf("the licence is returned\n"); }
#endif

/* its log is the one of the last instance */
static void complain(void);

static int step(Wsp *w)
{
    long counts[4];
#ifdef FAIL_AT_S
    if (w->time > FAIL_AT_S) {
        complain();
        return 3;
    }
#endif
#ifdef DISCARD_AT_S
    if (w->time > DISCARD_AT_S) return 2;
#endif
#ifdef HANG_AT_S
    while (w->time > HANG_AT_S) { }
#endif
#ifdef CRASH_AT_S
    if (w->time > CRASH_AT_S) { printf("the next step crashes\n"); CRASH; }
#endif
    for (int j = 0; j < 4; j++) counts[j] = lrint(w->in[j] * SPEED_UNIT / SPEED_SCALE);
    measure(w, counts);
    advance(w);
    choose_runner(w);
    finish_run_up(w);
    w->cycles += 1.0;
    for (int j = 0; j < 4; j++) act(w, j, event_of(w, j));
    w->time += CYCLE_S;
#ifdef NAN_AT_S
    if (w->time > NAN_AT_S) w->reference = NAN;
#endif
    return 0;
}

static double *place(Wsp *w, unsigned vr) { return vr < 8 ? &w->in[vr] : &w->reference; }
static int valve(const Wsp *w, unsigned vr) { return vr < 12 ? w->hold[vr - 8] : w->vent[vr - 12]; }

#ifdef LS_BUS
#include "can_node.c"
static void complain(void) {}
#elif defined(FMI2)
#include "fmi2Functions.h"
static const fmi2CallbackFunctions *callbacks;
static void complain(void)
{
    callbacks->logger(callbacks->componentEnvironment, "wsp", fmi2Error, "logStatusError", "wheel %d of %s is lost", 3, "the WSP");
}
#define EACH for (size_t i = 0; i < n; i++)
const char *fmi2GetTypesPlatform(void) { return fmi2TypesPlatform; }
const char *fmi2GetVersion(void) { return fmi2Version; }
fmi2Component fmi2Instantiate(fmi2String name, fmi2Type type, fmi2String guid, fmi2String resources,
                              const fmi2CallbackFunctions *call, fmi2Boolean visible, fmi2Boolean logging)
{
    callbacks = call;
    call->logger(call->componentEnvironment, name, fmi2OK, "logAll", "%s of the FMU is there", "the WSP");
    return calloc(1, sizeof(Wsp));
}
void fmi2FreeInstance(fmi2Component c) { free(c); }
fmi2Status fmi2SetupExperiment(fmi2Component c, fmi2Boolean a, fmi2Real b, fmi2Real d, fmi2Boolean e, fmi2Real f) { return fmi2OK; }
fmi2Status fmi2EnterInitializationMode(fmi2Component c) { return fmi2OK; }
fmi2Status fmi2ExitInitializationMode(fmi2Component c) { return fmi2OK; }
fmi2Status fmi2Terminate(fmi2Component c) { return fmi2OK; }
fmi2Status fmi2Reset(fmi2Component c) { memset(c, 0, sizeof(Wsp)); return fmi2OK; }
fmi2Status fmi2SetReal(fmi2Component c, const fmi2ValueReference vr[], size_t n, const fmi2Real v[]) { EACH *place(c, vr[i]) = v[i]; return fmi2OK; }
fmi2Status fmi2GetReal(fmi2Component c, const fmi2ValueReference vr[], size_t n, fmi2Real v[]) { EACH v[i] = *place(c, vr[i]); return fmi2OK; }
fmi2Status fmi2GetBoolean(fmi2Component c, const fmi2ValueReference vr[], size_t n, fmi2Boolean v[]) { EACH v[i] = valve(c, vr[i]); return fmi2OK; }
fmi2Status fmi2DoStep(fmi2Component c, fmi2Real t, fmi2Real dt, fmi2Boolean k) { return step(c); }
#else
#include "fmi3Functions.h"
static fmi3InstanceEnvironment log_environment;
static fmi3LogMessageCallback log_message;
static void complain(void)
{
    log_message(log_environment, fmi3Error, "logStatusError", "wheel 3 of the WSP is lost");
}
#define EACH for (size_t i = 0; i < n; i++)
const char *fmi3GetVersion(void) { return fmi3Version; }
fmi3Instance fmi3InstantiateCoSimulation(fmi3String name, fmi3String token, fmi3String resources, fmi3Boolean visible,
    fmi3Boolean logging, fmi3Boolean event, fmi3Boolean early, const fmi3ValueReference needed[], size_t n,
    fmi3InstanceEnvironment env, fmi3LogMessageCallback log, fmi3IntermediateUpdateCallback update)
{
    log_environment = env;
    log_message = log;
    log(env, fmi3OK, "logAll", "the WSP of the FMU is there");
    return calloc(1, sizeof(Wsp));
}
void fmi3FreeInstance(fmi3Instance c) { free(c); }
fmi3Status fmi3EnterInitializationMode(fmi3Instance c, fmi3Boolean a, fmi3Float64 b, fmi3Float64 d, fmi3Boolean e, fmi3Float64 f) { return fmi3OK; }
fmi3Status fmi3ExitInitializationMode(fmi3Instance c) { return fmi3OK; }
fmi3Status fmi3Terminate(fmi3Instance c) { return fmi3OK; }
fmi3Status fmi3Reset(fmi3Instance c) { memset(c, 0, sizeof(Wsp)); return fmi3OK; }
fmi3Status fmi3SetFloat64(fmi3Instance c, const fmi3ValueReference vr[], size_t n, const fmi3Float64 v[], size_t m) { EACH *place(c, vr[i]) = v[i]; return fmi3OK; }
fmi3Status fmi3GetFloat64(fmi3Instance c, const fmi3ValueReference vr[], size_t n, fmi3Float64 v[], size_t m) { EACH v[i] = *place(c, vr[i]); return fmi3OK; }
fmi3Status fmi3GetBoolean(fmi3Instance c, const fmi3ValueReference vr[], size_t n, fmi3Boolean v[], size_t m) { EACH v[i] = valve(c, vr[i]); return fmi3OK; }
fmi3Status fmi3DoStep(fmi3Instance c, fmi3Float64 t, fmi3Float64 dt, fmi3Boolean k, fmi3Boolean *event, fmi3Boolean *end,
                      fmi3Boolean *early, fmi3Float64 *last)
{
    *event = *end = *early = fmi3False;
    *last = t + dt;
#ifdef TERMINATE_AT_S
    *end = ((Wsp *)c)->time > TERMINATE_AT_S;
#endif
    return step(c);
}
#endif
