/* The rules of the reference WSP (firmware_sim/wsp) in C, for four axles, as an FMU for co-simulation: FMI 3, or FMI 2
   with -DFMI2, or a CAN node with -DLS_BUS.
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
    /* memory of the rules: names as in firmware_sim/wsp/logic.py, ages in cycles */
    double cycles, speed[4], lagged[4], slope[4], falling[4], deceleration, anchored, anchor_age, calm, calm_lagged, run_ups;
    double sliding[4], measured[4], rim[4], same[4], still[4], disputed[4], relief[4], plausible[4];
    double phase_age[4], pulse[4], free_age[4], vent_age[4], hold_age[4];
    long raw[4];
    int accused[4], out[4], runner, phase[4];
} Wsp;

#define EACH_AXLE for (int j = 0; j < 4; j++)

static int passed(double cycles, double duration) { return (cycles + 0.5) * CYCLE_S >= duration; }
static double least(double a, double b) { return a < b ? a : b; }
static double most(double a, double b) { return a > b ? a : b; }
static int trusted(const Wsp *w)
{
    int count = 0;
    EACH_AXLE count += !w->out[j];
    return count;
}

/* sensors.py */
static int jumps(double before, double now)
{
    double change = now - before;
    return change < -(JUMP_M_S + JUMP_FALL_M_S2 * CYCLE_S) || change > JUMP_M_S + JUMP_RISE_M_S2 * CYCLE_S;
}

static int far_above(double faster, double slower) { return faster > slower * (1.0 + AGREE_FRACTION) + AGREE_M_S; }

static int among_trusted_axles(const Wsp *w, int i)
{
    double slowest = INFINITY, fastest = w->reference;
    EACH_AXLE if (!w->out[j]) {
        slowest = least(slowest, w->measured[j]);
        fastest = most(fastest, w->measured[j]);
    }
    if (slowest == INFINITY) return 1;
    return !far_above(w->measured[i], fastest) && !far_above(slowest, w->measured[i]);
}

static int runs_free(const Wsp *w, int i)
{
    if (w->out[i] || !passed(w->free_age[i], FREE_S) || passed(w->still[i], STUCK_S)) return 0;
    return w->slope[i] < RUN_UP_DONE_M_S2;
}

static void accuse(Wsp *w, int i)
{
    double expected = w->anchored - w->deceleration * (w->anchor_age * CYCLE_S);
    double against = 0.0, witnesses = 0.0, nearest = INFINITY;
    EACH_AXLE {
        if (w->out[j]) continue;
        if (far_above(w->speed[j], w->speed[i])) {
            if (passed(w->still[j], STUCK_S)) {
                w->accused[j] = 1;
                continue;
            }
            against += 1.0;
            nearest = least(nearest, fabs(w->speed[j] - expected));
        } else if (runs_free(w, j)) {
            witnesses += !far_above(w->speed[i], w->speed[j]);
        }
    }
    if (against == 0.0) return;
    if (against >= 2.0) *(nearest < fabs(w->speed[i] - expected) ? &against : &witnesses) += EXPECTATION;
    if (against > witnesses) {
        w->accused[i] = 1;
        return;
    }
    EACH_AXLE if (!w->out[j] && far_above(w->speed[j], w->speed[i])) w->accused[j] = 1;
}

static void judge(Wsp *w, const long *counts)
{
    int all = trusted(w), moving = 0;
    EACH_AXLE {
        moving += !w->out[j] && counts[j] != w->raw[j];
        w->accused[j] = 0;
    }
    EACH_AXLE if (runs_free(w, j)) accuse(w, j);
    EACH_AXLE w->disputed[j] = w->accused[j] ? w->disputed[j] + 1.0 : 0.0;
    EACH_AXLE {
        int impossible = w->cycles > 0.0 && jumps(w->rim[j], w->measured[j]);
        int silent;
        w->still[j] = counts[j] != w->raw[j] ? 0.0 : w->still[j] + 1.0;
        silent = (counts[j] == 0 || passed(w->still[j], SILENT_S)) && passed(w->free_age[j], SILENT_S);
        if (counts[j] != w->raw[j] || counts[j] == 0) w->same[j] = 0.0;
        else if (moving > 0 && moving >= (all > 2 ? 2 : all - 1)) w->same[j] += 1.0;
        if (w->out[j] && !among_trusted_axles(w, j)) impossible = 1;
        if (impossible || passed(w->same[j], STUCK_S) || passed(w->disputed[j], CONFIRM_S) || (silent && !w->out[j])) {
            w->out[j] = 1;
            w->plausible[j] = 0.0;
        } else {
            w->plausible[j] += 1.0;
            if (passed(w->plausible[j], TRUST_AGAIN_S)) w->out[j] = 0;
        }
    }
    EACH_AXLE {
        w->raw[j] = counts[j];
        w->rim[j] = w->measured[j];
    }
}

static int followed(const Wsp *w, int j)
{
    for (int step = 1; step < 4; step++)
        if (!w->out[j ^ step]) return j ^ step;
    return NOBODY;
}

/* reference_speed.py */
static void measure(Wsp *w, const long *counts)
{
    EACH_AXLE {
        w->measured[j] = fabs((double)counts[j]) * SPEED_SCALE * 0.5 * DIAMETER[j];
        if (w->cycles == 0.0) w->lagged[j] = w->measured[j];
    }
    judge(w, counts);
    EACH_AXLE {
        w->speed[j] = w->measured[j];
        w->slope[j] = (w->speed[j] - w->lagged[j]) / ACCELERATION_FILTER_S;
        w->lagged[j] += w->slope[j] * CYCLE_S;
    }
    EACH_AXLE {
        int source = w->out[j] ? followed(w, j) : j;
        if (source >= 0) {
            w->speed[j] = w->speed[source];
            w->slope[j] = w->slope[source];
        }
        w->falling[j] = w->slope[j] < -FALL_M_S2 ? w->falling[j] + 1.0 : 0.0;
    }
}

static void advance(Wsp *w)
{
    double fastest = 0.0, fall, calm_slope, before;
    int sliding = 0;
    EACH_AXLE {
        if (!w->out[j]) fastest = most(fastest, w->speed[j]);
        sliding |= w->phase[j] != FILL || passed(w->falling[j], CONFIRM_S);
    }
    if (w->cycles == 0.0) {
        w->reference = w->anchored = fastest;
        w->deceleration = FIRST_DECELERATION_M_S2;
        w->runner = NOBODY;
    }
    if (!passed(w->calm, CALM_S)) w->calm_lagged = fastest;
    calm_slope = (w->calm_lagged - fastest) / CALM_S;
    w->calm_lagged -= calm_slope * CYCLE_S;
    fall = most(REFERENCE_FALL_M_S2, least(calm_slope + DECELERATION_MARGIN_M_S2, FALL_M_S2));
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

static int trailing(const Wsp *w, int turn)
{
    int all = trusted(w), skip;
    if (all == 0) return NOBODY;
    skip = turn % (all < RUN_UP_AXLES ? all : RUN_UP_AXLES);
    for (int j = 3; j >= 0; j--)
        if (!w->out[j] && skip-- == 0) return j;
    return NOBODY;
}

static void choose_runner(Wsp *w)
{
    if (w->reference < CUT_OFF_M_S) {
        w->runner = NOBODY;
        return;
    }
    if (w->runner != NOBODY && w->out[w->runner]) w->runner = NOBODY;
    if (w->runner == NOBODY && passed(w->anchor_age, w->run_ups == 0.0 ? RUN_UP_FIRST_S : RUN_UP_INTERVAL_S)) {
        w->runner = trailing(w, (int)w->run_ups);
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

/* logic.py */
static void band(const Wsp *w, double *low, double *high)
{
    int all = trusted(w);
    double per_axle = w->deceleration * 4 / (all > 1 ? all : 1);
    double span = most(WIDE_ABOVE_M_S2 - NARROW_BELOW_M_S2, 1e-3);
    double share = NARROW_SHARE + (1.0 - NARROW_SHARE) * least(most((per_axle - NARROW_BELOW_M_S2) / span, 0.0), 1.0);
    *low = least(BAND_LOW_M_S, share * BAND_LOW_FRACTION * w->reference);
    *high = least(BAND_HIGH_M_S, share * BAND_HIGH_FRACTION * w->reference);
}

static int event_of(Wsp *w, int j)
{
    double v = w->reference, s = w->sliding[j] = v - w->speed[j], a = w->slope[j], low, high;
    double begin = SLIDE_BEGIN_M_S + SLIDE_BEGIN_FRACTION * v;
    band(w, &low, &high);
    int row = (s > begin) + (s > low) + (s > high) + (s > high * DEEP_FACTOR);
    int column = (a > -FAST_FALL_M_S2) + (a > -FALL_M_S2) + (a > RISE_M_S2) + (a > FAST_RISE_M_S2);
    int event = WISHES[row][column];
    if (w->runner == j) event = E_RUN_UP;
    if (passed(w->vent_age[j], VENT_TIMER_S) || passed(w->hold_age[j], HOLD_TIMER_S)) event = E_TIMER;
    if (v < CUT_OFF_M_S) event = E_CUT_OFF;
    return event;
}

static double pulse_of(const Wsp *w, int j, int phase)
{
    double low, high, excess;
    band(w, &low, &high);
    excess = -w->deceleration - w->slope[j] + (w->sliding[j] - 0.5 * (low + high)) / APPROACH_S;
    if (phase == STEP_FILL) return least(most(-excess * FILL_GAIN_S3_M, FILL_PULSE_SHORTEST_S), FILL_PULSE_S);
    if (phase == STEP_VENT) return least(most(excess * VENT_GAIN_S3_M, VENT_PULSE_S), VENT_PULSE_LONGEST_S);
    return phase == LOCKED_OUT ? LOCK_OUT_S : 0.0;
}

static void act(Wsp *w, int j, int event)
{
    double pause = w->phase[j] == STEP_FILL ? FILL_PAUSE_S : w->phase[j] == STEP_VENT ? VENT_PAUSE_S : 0.0;
    int following = NEXT[w->phase[j]][event], magnets;
    if (event == FILL) pause = least(pause, REFILL_PAUSE_S);
    if ((passed(w->phase_age[j], w->pulse[j] + pause) || INTERRUPTS[w->phase[j]][event])
        && (following != w->phase[j] || w->pulse[j] > 0.0)) {
        w->phase[j] = following;
        w->phase_age[j] = 0.0;
        w->pulse[j] = pulse_of(w, j, following);
    }
    magnets = MAGNETS[w->phase[j]][passed(w->phase_age[j], w->pulse[j])];
    w->phase_age[j] += 1.0;
    w->hold[j] = magnets & 1;
    w->vent[j] = magnets >> 1;
    w->free_age[j] = w->vent[j] ? w->free_age[j] + 1.0 : 0.0;
    w->vent_age[j] = magnets == 0 ? 0.0 : w->vent_age[j] + (w->vent[j] != 0);
    w->hold_age[j] = magnets == 0 ? 0.0 : w->hold_age[j] + (w->vent[j] == 0);
}

/* an axle whose sensor is rejected */
static void follow(Wsp *w, int j)
{
    int leader = followed(w, j), relieved;
    if (leader == NOBODY) {
        w->phase[j] = FILL;
        w->phase_age[j] = w->free_age[j] = w->vent_age[j] = w->hold_age[j] = 0.0;
        w->hold[j] = w->vent[j] = 0;
        return;
    }
    w->sliding[j] = w->sliding[leader];
    w->phase[j] = w->phase[leader];
    w->phase_age[j] = w->phase_age[leader];
    w->free_age[j] = w->free_age[leader];
    w->vent_age[j] = w->vent_age[leader];
    w->hold_age[j] = w->hold_age[leader];
    w->hold[j] = w->hold[leader];
    w->vent[j] = w->vent[leader];
    if (w->calm > 0.0) {
        w->relief[j] = 0.0;
        return;
    }
    if (passed(w->relief[j], RELIEF_INTERVAL_S)) w->relief[j] = 0.0;
    relieved = !passed(w->relief[j], RELIEF_S);
    w->relief[j] += 1.0;
    if (relieved) {
        w->phase[j] = VENT;
        w->hold[j] = w->vent[j] = 1;
    }
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
    EACH_AXLE counts[j] = lrint(w->in[j] * SPEED_UNIT / SPEED_SCALE);
    measure(w, counts);
    advance(w);
    choose_runner(w);
    finish_run_up(w);
    w->cycles += 1.0;
    EACH_AXLE if (!w->out[j]) act(w, j, event_of(w, j));
    EACH_AXLE if (w->out[j]) follow(w, j);
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
