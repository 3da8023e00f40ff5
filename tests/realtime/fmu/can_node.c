/* A CAN node as an FMU, included by wsp.c with -DLS_BUS: the unit (node 32), or with -DTALKER a node beside it that
   sends TALK_ID ten times a second. FMI 3, FMI-LS-BUS 1.0 (CAN); written for this test after the standard's text.
   It has one transmit buffer: with BusNotifications it sends a frame only when the last has been confirmed.
   COUNTDOWN: its Tx_Clock tells intervals; else it is triggered, after a step of 1 ms. BAUD: what it configures.
   GARBAGE, FD: what else the unit sends with its fifth answer. DISCARD: it tells its frames that lose arbitration. */
#include "fmi3Functions.h"

#ifndef BAUD
#define BAUD 500000
#endif
#ifndef TALK_ID
#define TALK_ID 0x123
#endif
#define EACH for (size_t i = 0; i < n; i++)
enum { RX_DATA = 1, RX_CLOCK, TX_DATA, TX_CLOCK, NOTIFICATIONS };
enum { FORMAT_ERROR = 0x01, TRANSMIT = 0x10, FD_TRANSMIT = 0x11, CONFIRM = 0x20, LOST = 0x30, BUS_ERROR = 0x31,
       CONFIGURATION = 0x40, STATUS = 0x41 };
typedef unsigned char Byte;
typedef struct { unsigned length; Byte bytes[64]; } Operation;

typedef struct {
    Wsp wsp;
    Byte rx[4096], tx[64], speeds[8], magnets;
    size_t rx_length;
    int rx_clock, tx_clock, notifications, waiting, ended;
    Operation queue[64];
    unsigned first, last;
    double now;
    unsigned syncs, answers, spoken, errors, error, asked, heard;
} Node;

static unsigned number(const Byte *at, int bytes) { unsigned v = 0; while (bytes--) v = v << 8 | at[bytes]; return v; }
static void write_number(Byte *at, unsigned v, int bytes) { for (; bytes--; v >>= 8) *at++ = (Byte)v; }

static void queue(Node *c, unsigned code, const Byte *arguments, unsigned length)
{
    Operation *one = &c->queue[c->last++ % 64];
    one->length = 8 + length;
    write_number(one->bytes, code, 4);
    write_number(one->bytes + 4, one->length, 4);
    memcpy(one->bytes + 8, arguments, length);
}

static void transmit(Node *c, unsigned id, const Byte *data, unsigned length)
{
    Byte arguments[16] = {0};
    write_number(arguments, id, 4);
    write_number(arguments + 6, length, 2);
    memcpy(arguments + 8, data, length);
    queue(c, TRANSMIT, arguments, 8 + length);
}

static void beat(Node *c, unsigned state) { Byte data = (Byte)state; transmit(c, 0x720, &data, 1); }

static void begin(Node *c)
{
    Byte baud[5] = {1}, lost[2] = {4, 1};
    write_number(baud + 1, BAUD, 4);
    queue(c, CONFIGURATION, baud, 5);
#ifdef DISCARD
    lost[1] = 2;
#endif
    queue(c, CONFIGURATION, lost, 2);
#ifndef TALKER
    beat(c, 0);
    beat(c, 5);
#endif
}

static void answer(Node *c, const Byte *data)
{
    Byte reference[2];
    c->magnets = 0;
    for (int j = 0; j < 4; j++) c->wsp.in[j] = (short)number(data + 2 * j, 2) * SPEED_SCALE;
    step(&c->wsp);
    for (int j = 0; j < 4; j++) c->magnets |= (Byte)((c->wsp.hold[j] | c->wsp.vent[j] << 1) << 2 * j);
    if (c->syncs % 5 == 0) beat(c, 5);
    write_number(reference, (unsigned)lrint(c->wsp.reference * 100.0), 2);
    transmit(c, 0x1A0, reference, 2);
    transmit(c, 0x211, &c->magnets, 1);
    c->answers++;
#ifdef GARBAGE
    if (c->answers == 5) queue(c, 0x99, reference, 2);
#endif
#ifdef FD
    if (c->answers == 5) { Byte fd[9] = {0x23, 1}; queue(c, FD_TRANSMIT, fd, 9); }
#endif
}

static void hear(Node *c, unsigned code, const Byte *at)
{
    if (code == TRANSMIT) {
        unsigned id = number(at, 4);
#ifdef TALKER
        if (id == 0x211 && !c->heard++) printf("the talker hears the unit\n");
#else
        /* every SYNC gets its answer, without speeds the last one */
        if (id == 0x080 && c->asked) transmit(c, 0x211, &c->magnets, 1);
        if (id == 0x080) { c->asked = 1; c->heard = 0; c->syncs++; }
        if (id == 0x190) { c->heard = 1; memcpy(c->speeds, at + 8, 8); }
        if (id == 0x191 && c->asked) {
            if (c->heard) answer(c, c->speeds);
            else transmit(c, 0x211, &c->magnets, 1);
            c->asked = 0;
        }
        if (id == 0x123 && !c->spoken++) printf("the unit hears the talker\n");
#endif
    } else if (code == CONFIRM || code == LOST) {
        if (code == LOST && !c->errors++) printf("%03X has lost the arbitration\n", number(at, 4));
        c->waiting = 0;
    } else if (code == BUS_ERROR) {
        if (c->errors < 9 && at[4] + 1 != c->error) printf("bus error %d of %03X, flag %d, sender %d\n", at[4], number(at, 4), at[5], at[6]);
        c->error = at[4] + 1;
        if (at[6]) { Byte state = 2; queue(c, STATUS, &state, 1); c->waiting = 0; }
    } else if (code == FORMAT_ERROR) {
        printf("format error of %u bytes, code %02X\n", number(at, 2), at[2]);
        c->waiting = 0;
    }
}

/* what there is to send, as far as the transmit buffer takes it */
static int ready(const Node *c) { return c->first != c->last && !c->waiting; }

static void fill(Node *c, size_t *length)
{
    Operation *one = &c->queue[c->first++ % 64];
    memcpy(c->tx, one->bytes, *length = one->length);
    c->waiting = c->notifications && one->bytes[0] != CONFIGURATION && one->bytes[0] != STATUS;
}

const char *fmi3GetVersion(void) { return fmi3Version; }
fmi3Instance fmi3InstantiateCoSimulation(fmi3String name, fmi3String token, fmi3String resources, fmi3Boolean visible,
    fmi3Boolean logging, fmi3Boolean event, fmi3Boolean early, const fmi3ValueReference needed[], size_t n,
    fmi3InstanceEnvironment env, fmi3LogMessageCallback log, fmi3IntermediateUpdateCallback update)
{
    return event ? calloc(1, sizeof(Node)) : NULL;
}
void fmi3FreeInstance(fmi3Instance c) { free(c); }
fmi3Status fmi3EnterInitializationMode(fmi3Instance c, fmi3Boolean a, fmi3Float64 b, fmi3Float64 d, fmi3Boolean e, fmi3Float64 f) { return fmi3OK; }
fmi3Status fmi3ExitInitializationMode(fmi3Instance c) { begin(c); return fmi3OK; }
fmi3Status fmi3EnterEventMode(fmi3Instance c) { return fmi3OK; }
fmi3Status fmi3EnterStepMode(fmi3Instance c) { return fmi3OK; }
fmi3Status fmi3Terminate(fmi3Instance c) { return fmi3OK; }
fmi3Status fmi3SetBoolean(fmi3Instance c, const fmi3ValueReference vr[], size_t n, const fmi3Boolean v[], size_t m)
{
    EACH if (vr[i] != NOTIFICATIONS) return fmi3Error;
    ((Node *)c)->notifications = v[0];
    return fmi3OK;
}
fmi3Status fmi3SetClock(fmi3Instance c, const fmi3ValueReference vr[], size_t n, const fmi3Clock v[])
{
    EACH *(vr[i] == RX_CLOCK ? &((Node *)c)->rx_clock : &((Node *)c)->tx_clock) = v[i];
    return fmi3OK;
}
fmi3Status fmi3GetClock(fmi3Instance c, const fmi3ValueReference vr[], size_t n, fmi3Clock v[])
{
    EACH { v[i] = ((Node *)c)->tx_clock; }
    return fmi3OK;
}
fmi3Status fmi3SetBinary(fmi3Instance i, const fmi3ValueReference vr[], size_t n, const size_t size[], const fmi3Binary v[], size_t m)
{
    Node *c = i;
    if (vr[0] != RX_DATA || !c->rx_clock || size[0] > sizeof c->rx) return fmi3Error;
    memcpy(c->rx, v[0], c->rx_length = size[0]);
    return fmi3OK;
}
fmi3Status fmi3GetBinary(fmi3Instance i, const fmi3ValueReference vr[], size_t n, size_t size[], fmi3Binary v[], size_t m)
{
    Node *c = i;
    if (vr[0] != TX_DATA || !c->tx_clock) return fmi3Error;
    size[0] = 0;
    if (ready(c)) fill(c, size);
    v[0] = c->tx;
    return fmi3OK;
}
fmi3Status fmi3UpdateDiscreteStates(fmi3Instance i, fmi3Boolean *again, fmi3Boolean *end, fmi3Boolean *a, fmi3Boolean *b,
                                    fmi3Boolean *defined, fmi3Float64 *next)
{
    Node *c = i;
    *again = *end = *a = *b = *defined = fmi3False;
    if (c->rx_clock)
        for (Byte *at = c->rx; at < c->rx + c->rx_length; at += number(at + 4, 4)) hear(c, number(at, 4), at + 8);
    c->rx_length = c->rx_clock = c->tx_clock = 0;
    return fmi3OK;
}
fmi3Status fmi3GetIntervalDecimal(fmi3Instance i, const fmi3ValueReference vr[], size_t n, fmi3Float64 v[], fmi3IntervalQualifier q[])
{
    v[0] = 0.0005;
    q[0] = ready(i) ? fmi3IntervalChanged : fmi3IntervalNotYetKnown;
    return fmi3OK;
}
fmi3Status fmi3DoStep(fmi3Instance i, fmi3Float64 t, fmi3Float64 dt, fmi3Boolean k, fmi3Boolean *event, fmi3Boolean *end,
                      fmi3Boolean *early, fmi3Float64 *last)
{
    Node *c = i;
    if (fabs(t - c->now) > 1e-9) return fmi3Error;
#ifdef TALKER
    for (; (c->spoken + 1) * 0.1 <= t + dt + 1e-9; c->spoken++) transmit(c, TALK_ID, (const Byte *)"hello", 5);
#endif
    *event = *end = *early = fmi3False;
    *last = c->now = t + dt;
#ifndef COUNTDOWN
    *event = c->tx_clock = ready(c);
#endif
    return fmi3OK;
}
